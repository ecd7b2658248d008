"""Kinds of presets share some names: every message says which kind it speaks of."""

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.presets import NAMES, check_preset
from dreamfleet.coordinator import presets as runs
from dreamfleet.worker.baselines import presets as baselines
from dreamfleet.worker.training import presets


def test_the_names_are_those_that_each_side_has_settings_for():
    assert set(NAMES["run"]) == set(runs.PRESETS)
    assert set(NAMES["training"]) == set(presets.PRESETS)
    assert set(NAMES["baseline"]) == set(baselines.PRESETS)


def test_a_name_of_the_other_kind_is_told_apart():
    with pytest.raises(UsageError, match=r"unknown run preset 'notebook'.*'notebook' is a preset of training"):
        check_preset("run", "notebook")
    with pytest.raises(UsageError, match=r"unknown training preset 'dream'.*'dream' is a preset of run"):
        presets.find_preset("dream")
    with pytest.raises(UsageError, match=r"unknown baseline preset 'tiny'.*'tiny' is a preset of training"):
        baselines.find_preset("tiny")
