"""What a controller tells of the run that it came from."""

import base64
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.runs.effort import Effort, format_steps
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_provenance import (
    RECEIPT,
    RunProvenance,
    StartProvenance,
    read_run_provenance,
    read_run_settings,
    validation_seed_ranges,
)
from dreamfleet.common.serialization.optional_fields import to_dict
from tests.support.samples import SPEC

SETTINGS = RunSettings(SPEC, ControllerShape(1), 4, 2, 0.1, "diagonal", 1, 2, 3, confirm_episodes=8)
MEAN = np.array([0.1, -2.0, 1e-300])
START = StartProvenance.of("run a", base64.b64encode(MEAN.tobytes()).decode(), Effort(driven=5))
RECEIPTS = RunProvenance(
    7, Effort(10, 2, 0, 3_600_000), START, "x86", True, {"numpy": "2"}, {"evaluation": (20_000, 3)}
)


def controller(**provenance):
    shape = ControllerShape(1)
    return Controller(shape, np.zeros(shape.size, np.float32), "car-racing", "ab" * 32, provenance)


@pytest.mark.parametrize("receipt", [RECEIPTS, RunProvenance(0, Effort())])
def test_a_receipt_comes_back_from_a_controllers_file(tmp_path, receipt):
    controller(**{RECEIPT: to_dict(receipt)}).save(tmp_path / "a.npz")
    found = read_run_provenance(Controller.load(tmp_path / "a.npz"))
    assert found == receipt
    if found.start is not None:
        assert np.array_equal(found.start.vector, MEAN)
        assert found.total == Effort(15, 2, 0, 3_600_000)


def test_what_an_earlier_version_wrote_is_repeated_from_what_it_tells(tmp_path):
    tiny, _ = find_controller("tiny", tmp_path)
    found = read_run_provenance(tiny)
    assert (found.generations, found.effort, found.start) == (25, Effort(dreamt=10_240_000), None)
    assert read_run_settings(tiny).task.temperature == 1.5


@pytest.mark.parametrize("told", [{}, {RECEIPT: 1}, {RECEIPT: {"generations": -1}}, {"settings": {}, "generation": 1}])
def test_a_controller_without_a_receipt_says_so(told):
    with pytest.raises(ControllerError, match="run"):
        read_run_provenance(controller(**told))


def test_a_start_that_is_not_the_one_that_was_hashed_is_refused():
    with pytest.raises(ControllerError, match="damaged"):
        _ = replace(START, mean=START.mean[:-4]).vector


def test_it_names_the_seeds_that_judged():
    assert validation_seed_ranges(SETTINGS) == {"evaluation": (20_000, 3), "confirmation": (40_000, 8)}
    assert validation_seed_ranges(replace(SETTINGS, evaluate_every=0, confirm_episodes=0)) == {}


def test_effort_counts_reality_apart_from_the_dream():
    kinds = [("car-racing", "score"), ("car-racing", "evaluate"), ("dream", "score"), ("dream", "evaluate")]
    found = sum((Effort.of(task, kind, 10.0, 1e6) for task, kind in kinds), Effort.of("dream", "collect", 5, 0))
    assert (found.driven, found.judged, found.dreamt, found.steps) == (15, 20, 10, 35)
    assert found.core_hours == pytest.approx(4 / 3600)
    assert Effort.of("car-racing", "score", float("inf"), 0).driven == 2**63 - 1
    assert found.description == "35 steps in reality, 10 dreamt, 0.00111 core-hours"


@pytest.mark.parametrize(
    ("steps", "said"), [(930, "930"), (12_345, "12.3k"), (28 * 10**5, "2.8M"), (17 * 10**8, "1.7G")]
)
def test_steps_are_said_shortly(steps, said):
    assert format_steps(steps) == said
