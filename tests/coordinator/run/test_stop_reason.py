"""Limits that read the candidates' fitness: a target of one candidate, and generations without a better one.
Tests common/protocol/stop_kind.py."""

import re
from dataclasses import replace
from math import inf, nan
from types import SimpleNamespace

import pytest

from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.stop_kind import StopKind
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.run.stop_reason import find_stop_reason
from dreamfleet.coordinator.settings.limits import LimitsConfig
from tests.support.samples import SPEC

NO_JOBS = SimpleNamespace(evaluations=SimpleNamespace(best=None))
FALLEN = SimpleNamespace(
    evaluations=SimpleNamespace(best=StoredEvaluation(0, 10, 5.0, 1.0)), have_fallen_behind=lambda limit: limit == 2
)
OPEN = SimpleNamespace(is_one_point=False, number=9)


def find(limits, *best, task="gym:CartPole-v1", options="", spread=2.0, jobs=NO_JOBS, generation=OPEN):
    rows = (StoredGeneration(number, each, 1.0, each, each - spread, 0.1, 10, 1.0) for number, each in enumerate(best))
    return find_stop_reason(limits, History(rows), jobs, generation, replace(SPEC, task=task, options=options))


def reason(*given, **more):
    found = find(*given, **more)
    return found and found.text


@pytest.mark.parametrize(
    ("kind", "limits"),
    [
        (StopKind.GENERATIONS, {"generations": 4}),
        (StopKind.STEPS, {"steps": 40}),
        (StopKind.MINUTES, {"minutes": 4 / 60}),
        (StopKind.CANDIDATE_TARGET, {"candidate_target": 2.0}),
        (StopKind.STAGNATION, {"stagnation": 2}),
        (StopKind.TARGET, {"target": 5.0}),
        (StopKind.PARTED, {"parted": 2}),
        (StopKind.ONE_POINT, {}),
    ],
)
def test_each_end_has_its_kind(kind, limits):
    generation = SimpleNamespace(is_one_point=kind is StopKind.ONE_POINT, number=9)
    found = find(LimitsConfig(**limits), 2, 1, 1, 1, jobs=FALLEN, generation=generation)
    assert found.kind is kind
    assert StopKind.parse(found.kind.value) is kind
    assert StopKind.parse("of a later version") is None
    assert "--" not in found.text, "a search in Python says it too"


def test_a_run_ends_when_a_candidate_reaches_the_target():
    assert reason(LimitsConfig(candidate_target=3.0), 1, 2.9) is None
    assert "3.0" in reason(LimitsConfig(candidate_target=3.0), 1, 3, 2)
    assert reason(LimitsConfig(candidate_target=0.0), -1e-13, 0.0)


def test_a_run_ends_after_so_many_generations_without_a_better_candidate():
    limits = LimitsConfig(stagnation=3)
    assert reason(limits) is None
    assert reason(limits, 1, 2, 1, 2) is None
    assert re.search(r"\b1\b.*1e-11.*\b3\b", reason(limits, 1, 2, 1, 2, 2))
    assert reason(limits, 1, 2, 1, 2, 2.5) is None
    creeping = [1 + 1e-12 * number for number in range(20)]
    assert reason(limits, *creeping[:4]) is not None, "less than any use"
    assert reason(limits, *(1 + 4e-12 * number for number in range(20))) is None, "but many small steps count"
    small = [1e-14 * each for each in (1, 2, 1, 2, 2.1)]
    assert reason(limits, *small) is not None
    assert reason(limits, *small, spread=2e-14) is None, "of a function whose values differ by less than 1"


def test_of_a_function_evaluations_are_counted_and_a_minimised_target_is_named_by_its_value():
    options = Objective.of({"x0": [0.0], "minimise": True}).options
    task = {"task": "function:mine:cost", "options": options}
    assert reason(LimitsConfig(steps=20), 1, 2) != reason(LimitsConfig(steps=20), 1, 2, **task)
    assert re.search(r"\b0\.25", reason(LimitsConfig(candidate_target=-0.5), -2, -0.25, **task))


@pytest.mark.parametrize(
    ("flag", "wrong"), [("stagnation", -1), ("candidate-target", nan), ("target", nan), ("target", inf)]
)
def test_what_is_no_limit_is_refused(flag, wrong):
    with pytest.raises(UsageError, match=f"--{flag}"):
        LimitsConfig(**{flag.replace("-", "_"): wrong})
