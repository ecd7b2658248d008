"""Presets: errors name the kind of a preset, as kinds share names; help and docs list the values."""

import re
import shlex
from functools import partial

import pytest

from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.common.cli.presets import NAMES, check_preset
from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.settings import presets as runs
from dreamfleet.coordinator.settings.stage_tables import split_first_stage
from dreamfleet.coordinator.verbs import coordinator
from dreamfleet.worker.addons.baselines import presets as baselines
from dreamfleet.worker.addons.baselines import verb as baseline
from dreamfleet.worker.training import presets
from dreamfleet.worker.verbs import train
from tests.support.processes import ROOT


def test_the_names_match_the_presets_of_each_side_and_an_error_names_the_other_kind():
    assert set(NAMES["run"]) == set(runs.PRESETS)
    assert set(NAMES["training"]) == set(presets.PRESETS)
    assert set(NAMES["baseline"]) == set(baselines.PRESETS)
    for find, name, kind in (
        (partial(check_preset, "run"), "attentive", "training"),
        (presets.find_preset, "dream", "run"),
        (partial(check_preset, "baseline"), "tiny", "training"),
    ):
        with pytest.raises(UsageError, match=kind):
            find(name)


def test_help_lists_each_presets_values():
    training, learning = build_parser("train", train), build_parser("baseline.train", baseline.TRAIN)
    help_text = " ".join(training.format_all_help().split())
    assert "(default 0; pixels, takecover 1.0)" in help_text
    assert "(default 0; attentive, paper 10)" in help_text
    assert "(notebook 5,5,6,6)" in help_text
    assert "(default 16; notebook 64)" in " ".join(learning.format_all_help().split())


def test_docs_list_each_run_presets_values():
    page = (ROOT / "docs" / "reference" / "presets.md").read_text()
    described = dict(re.findall(r"^\| `([\w-]+)` \| `(--[^`]+)`", page, re.MULTILINE))
    assert described.keys() == runs.PRESETS.keys()
    for name, flags in described.items():
        named, _ = split_first_stage(runs.PRESETS[name].get("stages", ()))
        assert not named, "it would hide the flag of that name"
        said = vars(build_parser("coordinator", coordinator).parse_all(shlex.split(flags)))
        settings = {key: value for key, value in runs.PRESETS[name].items() if key not in ("stages", "preset_variant")}
        if variant := runs.PRESETS[name].get("preset_variant"):
            settings["variant"] = variant
        heard = {key: tuple(said[key]) if isinstance(said[key], list) else said[key] for key in settings}
        assert heard == settings
        assert flags.count("--") == len(settings)
