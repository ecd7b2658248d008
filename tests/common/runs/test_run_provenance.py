import base64
import re
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
    StartProvenance,
    read_run_provenance,
    read_run_settings,
    validation_seed_ranges,
)
from tests.support.samples import SPEC

SETTINGS = RunSettings(SPEC, ControllerShape(1, 3), 4, 2, 0.1, "diagonal", 1, 2, 3, confirm_episodes=8)
START = StartProvenance.of("run a", base64.b64encode(np.ones(3).tobytes()).decode(), Effort(driven=5))


def controller(**provenance):
    shape = ControllerShape(1, 3)
    return Controller(shape, np.zeros(shape.size, np.float32), "car-racing", "ab" * 32, provenance)


def test_an_older_controllers_provenance_is_derived(tmp_path):
    tiny, _ = find_controller("tiny", tmp_path)
    found = read_run_provenance(tiny)
    assert (found.generations, found.effort, found.start) == (25, Effort(dreamt=10_240_000), None)
    assert read_run_settings(tiny).task.temperature == 1.5


@pytest.mark.parametrize(
    "provenance", [{}, {RECEIPT: 1}, {RECEIPT: {"generations": -1}}, {"settings": {}, "generation": 1}]
)
def test_a_controller_without_receipt_or_a_start_with_a_wrong_hash_is_an_error(provenance):
    with pytest.raises(ControllerError):
        read_run_provenance(controller(**provenance))
    with pytest.raises(ControllerError):
        _ = replace(START, mean=START.mean[:-4]).vector


def test_effort_counts_reality_and_dream_separately_and_seeds_are_of_both_checks():
    assert validation_seed_ranges(SETTINGS) == {"evaluation": (20_000, 3), "confirmation": (40_000, 8)}
    assert validation_seed_ranges(replace(SETTINGS, evaluate_every=0, confirm_episodes=0)) == {}
    said = {930: "930", 12_345: "12.3k", 28 * 10**5: "2.8M", 17 * 10**8: "1.7G"}
    assert {steps: format_steps(steps) for steps in said} == said
    kinds = [("car-racing", "score"), ("car-racing", "evaluate"), ("dream", "score"), ("dream", "evaluate")]
    found = sum((Effort.of(task, kind, 10.0, 1e6) for task, kind in kinds), Effort.of("dream", "collect", 5, 0))
    assert (found.driven, found.judged, found.dreamt, found.steps) == (15, 20, 10, 35)
    assert found.core_hours == pytest.approx(4 / 3600)
    assert Effort.of("car-racing", "score", float("inf"), 0).driven == 2**63 - 1
    assert re.match(r"35 .*, 10 .*, 0\.00111 ", found.describe("car-racing"))
    assert re.match(r"7 .*, 0\.000278 ", Effort.of("function:m:f", "score", 7, 1e6).describe("function:m:f"))
