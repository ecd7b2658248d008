"""What is finished, as the folder keeps it.
Tests dreamfleet/experiments/local/kept_document.py and dreamfleet/experiments/local/kept_words.py."""

import argparse
import json
from dataclasses import replace

import pytest

from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.common.cli.global_config import complete_arguments
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.host.stop_signals import never_stop
from dreamfleet.common.host.trusted_modules import VARIABLE
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.ledger import Artefact, IterationLedger
from dreamfleet.experiments.verbs import iterate as iterate_verb
from tests.support.ledgers import RUN, entry, ledger, requests


def kept(written, folder):
    """A ledger as it is read from the disk."""
    written.save(folder / "iteration.json")
    return IterationLedger.load(folder / "iteration.json")


def test_it_is_kept_whole(tmp_path):
    written = ledger(entry(1, "collect", [Artefact("episodes/000000.npz", "ab" * 32)], episodes=1, new=1))
    assert kept(written, tmp_path) == written
    assert IterationLedger.load(tmp_path / "absent.json") is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"format": 1', '"format": 2'),
        lambda text: text.replace('"noise": 0.3', '"noise": -1'),
        lambda text: text.replace('"noise": 0.3', '"noise": 0.3, "nosie": 1'),
        lambda text: text.replace('"seconds": 1.5', '"seconds": "long"'),
        lambda text: text.replace('"episodes": 1,', '"episodes": "one",'),
        lambda text: text.replace('"collect"', '"gate"'),
        lambda text: text.replace('"collect"', '"sing"'),
        lambda _text: "[" * 100_000,
    ],
)
def test_damage_is_one_line_with_a_remedy(tmp_path, damage):
    path = tmp_path / "iteration.json"
    ledger(entry(1, "collect", episodes=1, new=1)).save(path)
    path.write_text(damage(path.read_text()))
    with pytest.raises(DatasetError, match=r"iteration\.json"):
        IterationLedger.load(path)


def test_the_last_model_that_no_gate_refused_counts():
    found = ledger(entry(1, "bundle"), entry(2, "bundle"))
    assert found.model_round(1) == 1
    refused = found.add(entry(2, "gate", kept=False)).add(entry(3, "bundle"))
    assert refused.model_round(2) == 1
    assert refused.add(entry(3, "gate", kept=True)).model_round(3) == 3
    assert found.add(entry(2, "gate", kept=True)).model_round(2) == 2


def test_drives_are_counted_by_the_last_phase_that_made_some():
    assert ledger().episodes == 0
    assert ledger(entry(1, "collect", episodes=3), entry(1, "vae"), entry(2, "drive", episodes=5)).episodes == 5


def test_other_settings_are_refused_with_what_differs(tmp_path):
    begun = kept(ledger(), tmp_path)
    with pytest.raises(UsageError, match=r"noise 0\.3.* 0\.5.* seed 0.* 4.* population 64.* 32"):
        begun.with_settings(IterateConfig(noise=0.5, seed=4), {**RUN, "population": 32}, tmp_path)
    assert begun.with_settings(IterateConfig(), json.loads(json.dumps(RUN)), tmp_path) == begun


def test_a_ledger_from_before_a_setting_had_its_default(tmp_path):
    begun = ledger()
    del begun.settings["noise"]
    older = kept(begun, tmp_path)
    run = {name: value for name, value in RUN.items() if name != "population"}
    assert older.with_settings(IterateConfig(), RUN, tmp_path).settings == ledger().settings
    before = kept(replace(older, run=run), tmp_path)
    assert before.with_settings(IterateConfig(), RUN, tmp_path).run == before.run
    with pytest.raises(UsageError, match=r"noise 0\.3.* 0\.5"):
        older.with_settings(IterateConfig(noise=0.5), RUN, tmp_path)


@pytest.mark.parametrize("changes", [{"rounds": 9}, {"local": 1}, {"jobs": 3}, {"device": "cuda"}])
def test_what_changes_no_finished_round_is_taken(changes, tmp_path):
    begun = ledger(entry(1, "collect", episodes=1))
    taken = begun.with_settings(IterateConfig(**changes), RUN, tmp_path)
    assert taken.settings == {**begun.settings, **changes}
    assert taken.entries == begun.entries


def test_a_world_that_is_kept_is_the_same_when_it_is_read(tmp_path):
    config = IterateConfig(task="gym:Some-v0", environment=("mode=1",), skip=4)
    begun = kept(IterationLedger.begin(config, RUN), tmp_path)
    again = IterateConfig(**begun.settings)
    assert requests(**begun.settings).collect(1).world == requests(**vars(config)).collect(1).world != {}
    assert begun.with_settings(again, RUN, tmp_path).settings["task"] == "gym:Some-v0"
    with pytest.raises(UsageError, match=r"task gym:Some-v0.* gym:Other-v0"):
        begun.with_settings(replace(again, task="gym:Other-v0"), RUN, tmp_path)


def check_code(config, keeper, *given, environment=None):
    sources = {"file": {}, "environment": environment or {}}
    iterate_verb._check_code(argparse.Namespace(given=frozenset(given), sources=sources), config, keeper)


CODE = {
    "run_flags": "--generations 1 --optimiser strangers_choice:f",
    "later_run_flags": "--trust strangers_choice",
    "vae_flags": "--updates 1 --trust strangers_choice",
    "mdnrnn_flags": "--config strangers_choice.toml",
    "bundle_flags": "--trust=strangers_choice",
    "task": "gym:strangers_choice:Env-v0",
}


@pytest.mark.parametrize("name", CODE)
def test_a_kept_setting_chooses_no_code_and_one_of_the_user_is_known_again(tmp_path, name, monkeypatch):
    config, keeper = replace(IterateConfig(), **{name: CODE[name]}), tmp_path / "iteration.json"
    with pytest.raises(UsageError, match="strangers_choice"):
        check_code(config, keeper, "rounds")
    check_code(config, keeper, name)  # it is given now
    monkeypatch.setenv(VARIABLE, "")
    if name != "mdnrnn_flags":
        check_code(config, keeper)  # this user gave it here before
    monkeypatch.setenv(VARIABLE, "")
    other = "gym:strangers_choice:Env-v1" if name == "task" else f"{CODE[name]} --log-level info"
    with pytest.raises(UsageError, match="strangers_choice"):
        check_code(replace(config, **{name: other}), keeper)


def test_a_resumed_iteration_is_checked_before_anything_starts(tmp_path):
    layout = iterate_verb.IterationFolder(tmp_path)
    ledger().begin(replace(IterateConfig(), run_flags=CODE["run_flags"]), {}).save(layout.ledger)
    args = build_parser("iterate", iterate_verb).parse_all(["--data", str(tmp_path)])
    complete_arguments(args, {})
    with pytest.raises(UsageError, match="--trust strangers_choice"):
        iterate_verb._open_iteration(args, layout, never_stop)
