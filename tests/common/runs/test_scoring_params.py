"""The temperature of older runs with `heat`, which no new run can have."""

import dataclasses
import itertools

import pytest

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.protocol.messages import MAX_TEMPERATURE
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation
from dreamfleet.common.runs.scoring_params import ScheduleState, scoring_params_at
from tests.support.samples import SPEC

EVERY = 5
SETTINGS = RunSettings(
    dataclasses.replace(SPEC, temperature=1.0), ControllerShape(1, 3), 2, 1, 0.1, "diagonal", 1,
    evaluate_every=EVERY, evaluation_episodes=16, heat=1.5,
)  # fmt: skip


def checks(*means):
    """Evaluations after generations 4, 9, ... with standard error 10."""
    return [StoredEvaluation(EVERY * (index + 1) - 1, 16, mean, 40.0) for index, mean in enumerate(means)]


def temperature(generation, evaluations, settings=SETTINGS):
    return scoring_params_at(generation, settings, (), evaluations).spec.temperature


def raised(means, settings=SETTINGS):
    """The temperature of the first generation that depends on all evaluations."""
    found = temperature(EVERY * (len(means) + 1), checks(*means), settings)
    return None if found == settings.task.temperature else found


@pytest.mark.parametrize(
    ("means", "expected"),
    [
        ((), None),
        ((500.0,), None),
        ((100.0, 300.0, 500.0), None),
        ((500.0, 480.0, 475.0), None),  # behind, and not clearly
        ((500.0, 400.0), 1.5),
        ((100.0, 500.0, 480.0, 400.0), 1.5),
        ((500.0, 400.0, 300.0), 1.5),  # the first one after a raise is compared with none
        ((500.0, 400.0, 300.0, 310.0), 1.5),
        ((500.0, 400.0, 450.0, 300.0), 2.25),
        ((500.0, 400.0, 300.0, 200.0, 300.0, 200.0), 3.375),
    ],
)
def test_a_clear_fall_raises_the_temperature_and_restarts_the_comparison(means, expected):
    assert raised(means) == expected


def test_the_temperature_depends_on_evaluations_at_least_one_interval_old():
    found = [temperature(generation, checks(500.0, 400.0, 390.0)) for generation in range(20)]
    found = [None if each == SETTINGS.task.temperature else each for each in found]
    assert found == [None] * 15 + [1.5] * 5
    state = ScheduleState(SETTINGS)
    assert [state.required_evaluation(generation) for generation in (0, 9, 10, 14, 15)] == [-1, -1, 4, 4, 9]


def test_later_and_unscheduled_evaluations_and_their_order_do_not_matter():
    known = checks(500.0, 450.0, 500.0)
    stray = [StoredEvaluation(7, 16, 900.0, 40.0), *checks(0.0, 0.0, 0.0, 0.0, 0.0)[3:]]
    for order in itertools.permutations([*known, *stray]):
        assert temperature(20, order) == temperature(20, known) == 1.5


def test_the_temperature_is_bounded():
    hottest = dataclasses.replace(SETTINGS, heat=1e300)
    assert raised((500.0, 400.0, 300.0, 200.0), hottest) == MAX_TEMPERATURE


def test_without_heat_nothing_is_raised_or_required():
    cold = dataclasses.replace(SETTINGS, heat=1.0)
    assert raised((500.0, 400.0, 300.0, 200.0), cold) is None
    never = dataclasses.replace(cold, evaluate_every=0)
    assert [ScheduleState(each).required_evaluation(50) for each in (cold, never)] == [-1, -1]


def test_settings_and_digests_without_heat_are_unchanged():
    cold = dataclasses.replace(SETTINGS, heat=1.0)
    assert '"heat"' not in cold.to_json()
    assert RunSettings.from_json(cold.to_json()) == cold
    assert RunSettings.from_json(SETTINGS.to_json()) == SETTINGS
    written = "32b5b1f8a6bee0b22ed62a5034cdf1657709a3c7b15707ad38a792110c7c9de4"  # by the version before heat
    assert SPEC.digest("score", b"x" * 32, (1,)).hex() == written
    assert SPEC.with_overrides(None).digest("score", b"x" * 32, (1,)).hex() == written
