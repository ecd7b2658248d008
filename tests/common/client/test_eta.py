"""Estimates of a run's end. Tests equal_fitness.py and run_view.py too."""

import dataclasses
import re
from dataclasses import replace

import pytest

from dreamfleet.common.client.equal_fitness import ENOUGH, EqualFitness, describe_equal_fitness
from dreamfleet.common.client.eta import Rest, estimate_eta
from dreamfleet.common.client.run_view import LiveRunView
from dreamfleet.common.client.status import EpisodeProgress, FailureStatus, GenerationStatus, Throughput
from dreamfleet.common.printable import format_duration
from dreamfleet.common.runs.records import StoredGeneration
from tests.support.samples import BEST, CLOSED, STATUS

LEFT = dataclasses.replace(STATUS.worker_list[0], state="left", reason="no memory")


def status(limits=(), seconds=0.0, gone=0.0, **changes):
    recent = tuple(dataclasses.replace(CLOSED, seconds=each) for each in changes.pop("paces", (4.5, 4.6, 900.0)))
    return dataclasses.replace(
        STATUS, limits={"generations": 0, "steps": 0, "minutes": 0.0, "target": None, "parted": 0, **dict(limits)},
        recent=recent, throughput=Throughput(1000.0, changes.pop("steps", 448_000), seconds),
        **{"generation": GenerationStatus(3, 8, 7, gone, 0.09, None), **changes},
    )  # fmt: skip


def with_speed(status, candidates=None, evaluations=None):
    throughput = dataclasses.replace(
        status.throughput, episodes_per_second=candidates, evaluation_episodes_per_second=evaluations
    )
    return dataclasses.replace(status, throughput=throughput)


def test_a_limit_of_minutes_and_the_pace_without_a_generation_that_was_paused():
    eta = estimate_eta(status({"minutes": 30.0}, seconds=18 * 60))
    assert eta.description == "18 of 30 minutes, 4.6 s a generation, about 12 min to go"
    assert eta.share == eta.limits[0].share == pytest.approx(0.6)
    assert eta.seconds == pytest.approx(12 * 60)
    eta = estimate_eta(status({"generations": 1000, "minutes": 30.0}, seconds=18 * 60))
    assert [each.name for each in eta.limits] == ["minutes", "generations"], "the nearest first"
    assert eta.seconds == eta.limits[0].seconds


def test_the_pace_counts_the_evaluations_between():
    settings = dataclasses.replace(STATUS.settings, evaluate_every=4)

    def pace(seconds):
        recent = tuple(dataclasses.replace(CLOSED, number=n, seconds=each) for n, each in enumerate(seconds))
        return estimate_eta(dataclasses.replace(status(), settings=settings, recent=recent)).pace

    assert pace([5.0, 5.0, 5.0, 45.0] * 3) == pytest.approx((45 + 5 + 5 + 5) / 4)
    assert pace([5.0, 5.0, 5.0, 45.0] * 2 + [5.0, 5.0, 5.0, 9000.0]) == pytest.approx(15.0)
    assert pace([300.0, 5.0, 5.0, 45.0]) == pytest.approx(25.0), "one interval tells nothing yet"
    assert pace([300.0, 5.0, 5.0, 45.0, 5.0, 5.0, 5.0, 45.0]) == pytest.approx(15.0)
    assert pace([5.0] * 12 + [60.0] * 6) == pytest.approx(60.0), "a new stage shows after six generations"


def test_an_overdue_generation_without_a_step_has_no_estimate():
    overdue = status({"generations": 9}, gone=69.3)
    stalled = dataclasses.replace(overdue, throughput=dataclasses.replace(overdue.throughput, steps_per_second=0.0))
    assert estimate_eta(overdue).seconds is not None
    assert estimate_eta(stalled).description == "7 of 9 generations, 4.6 s a generation"


FAILURE = FailureStatus("7/1", "score", (1,), {"a": "no memory"}, {"a": 3}, retry_in=64.0)


@pytest.mark.parametrize(
    ("limits", "changes", "speed", "seconds"),
    [
        ({"generations": 9}, {"gone": 1.6}, None, 3.0 + 4.6),
        ({"generations": 8}, {"gone": 99.0}, None, 0),
        ({"generations": 8}, {"failures": (FAILURE,)}, None, 64.0),  # it waits for its next attempt
        ({"generations": 8}, {"failures": (dataclasses.replace(FAILURE, kind="evaluate"),)}, None, 4.6),
        # After workers were lost: 5 of 8 episodes are left.
        ({"generations": 10}, {"gone": 99.0}, 0.5, 10 + 16 + 16),
        ({"steps": 576_000}, {"paces": (8.0, 8.0)}, 0.5, 2 * 16.0),
        ({"generations": 8}, {"paces": ()}, 0.5, 10.0),
        ({"generations": 9}, {"paces": ()}, None, None),
        *(({"minutes": 30.0}, {"seconds": 60.0, "state": state}, None, None)
          for state in ("paused", "waiting for workers", "ended", "left")),
    ],
)  # fmt: skip
def test_the_time_to_go_is_of_the_open_generation_and_at_the_speed_that_remains(limits, changes, speed, seconds):
    found = estimate_eta(with_speed(status(limits, **changes), candidates=speed)).seconds
    assert found == (seconds and pytest.approx(seconds))


@pytest.mark.parametrize("speed", [1.3, 1.8, 2.5])  # 8 episodes in 4.6 s are 1.74 a second
def test_noise_of_episodes_moves_no_estimate(speed):
    found = estimate_eta(with_speed(status({"generations": 40}, gone=4.6), candidates=speed))
    assert found.pace == pytest.approx(4.6)
    assert found.seconds == pytest.approx(32 * 4.6 + 5 / speed)


def test_the_pace_that_is_shown_is_the_one_that_remains():
    found = estimate_eta(with_speed(status({"generations": 40}, gone=99.0), candidates=0.5))
    assert (found.pace, found.seconds) == (16.0, pytest.approx(32 * 16.0 + 10.0))


def test_steps_are_estimated_from_the_rate_of_closed_generations():
    eta = estimate_eta(status({"steps": 576_000}, paces=(10.0, 10.0)))  # each of 64,000 steps
    assert eta.description.startswith("448k of 576k steps")
    assert eta.seconds == pytest.approx(20.0)


@pytest.mark.parametrize("rate", [None, 0.5])
def test_the_end_is_that_of_search_evaluation_and_confirmation(rate):
    each = STATUS.settings.evaluation_episodes
    before = status({"minutes": 2.0}, seconds=60.0, closing=90, evaluating=EpisodeProgress(0, 0))
    eta = estimate_eta(with_speed(before, evaluations=rate))
    parts = [("evaluation", each), ("confirmation", 90 - each)]
    assert eta.rest == (Rest("search", 60.0), *(Rest(name, rate and count / rate, count) for name, count in parts))
    assert eta.seconds == (None if rate is None else 240.0)
    assert eta.share == pytest.approx(0.5 if rate is None else 60 / 300)


@pytest.mark.parametrize("rate", [None, 0.5])
def test_once_its_limit_is_reached_a_run_is_not_at_its_end(rate):
    ending = status(
        {"minutes": 1.0}, seconds=66.0, gone=40.0, state="evaluating", ending=True, closing=90,
        evaluating=EpisodeProgress(10, 16),
    )  # fmt: skip
    eta = estimate_eta(with_speed(ending, evaluations=rate))
    parts = [("evaluation", 6), ("confirmation", 84)]
    assert eta.rest == tuple(Rest(name, rate and count / rate, count) for name, count in parts)
    assert eta.share == pytest.approx(10 / 100 if rate is None else (66 + 20) / (66 + 20 + 180))
    assert eta.limits == ()
    reached = status({"target": 900.0}, state="evaluating", ending=True, closing=90)  # by an evaluation
    assert estimate_eta(with_speed(reached, evaluations=9.0)).seconds == 10.0


def test_a_target_score_has_no_estimate():
    eta = estimate_eta(status({"target": 900.0, "parted": 3}, best=BEST))
    assert re.search(r"900 .*120\.5.* 3 evaluations.* 4\.6 s", eta.description)
    assert eta.seconds is None


def test_without_a_number_or_a_generation_there_is_no_estimate():
    assert estimate_eta(status(paces=())).limits == ()
    for strange in ("many", None, [1], float("nan"), -3):
        limits = dict.fromkeys(("generations", "steps", "minutes", "target", "parted"), strange)
        assert estimate_eta(status(limits, seconds=1.0)).limits == ()


@pytest.mark.wording
@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({}, "7: 3 of 8 episodes"),
        ({"generation": dataclasses.replace(STATUS.generation, episodes_done=0, episodes=0)}, "7"),
        ({"state": "paused", "why": "asked for"}, "paused: asked for"),
        ({"state": "evaluating", "evaluating": EpisodeProgress(3, 16)}, "3 of 16 episodes"),
        ({"state": "evaluating", "confirming": EpisodeProgress(3, 1600)}, "3 of 1,600 episodes"),
        ({"state": "waiting for workers"}, "waiting for workers"),
        ({"state": "waiting for workers", "worker_list": (LEFT,)}, f"{LEFT.worker} .*0.3 s .*no memory"),
        ({"state": "waiting for workers", "refused": {"old-host": "no AVX2"}}, "old-host .*no AVX2"),
        ({"state": "left"}, "--resume night"),
        ({"state": "ended", "why": "30 minutes", "best": None}, "ended: 30 minutes"),
        ({"state": "of a later version"}, "of a later version"),
    ],
)
def test_states_are_described(changes, named):
    assert re.search(named, LiveRunView.of_status(status(**changes)).state)


def test_durations_are_formatted():
    said = {
        0.0: "0 s", 0.25: "0.25 s", 4.6: "4.6 s", 48.2: "48 s", 59.7: "1 min", 720: "12 min", 3599: "1 h",
        12_000: "3 h 20 min", 439_200: "5 d 2 h", 86_400 * 3: "3 d", float("inf"): "very long",
    }  # fmt: skip
    assert {seconds: format_duration(seconds) for seconds in said} == said


EQUAL = StoredGeneration(0, 1.0, 0.0, 1.0, 1.0, 0.1, 10, 1.0)
OTHER = replace(EQUAL, best=2.0)
FAILED = replace(EQUAL, failed=1)


@pytest.mark.parametrize(
    ("rows", "count"),
    [([], 0), ([EQUAL], 1), ([OTHER, EQUAL, EQUAL], 2), ([EQUAL, OTHER], 0), ([EQUAL, FAILED, EQUAL], 1)],
)
def test_the_last_generations_in_a_row_are_counted(rows, count):
    found = EqualFitness(rows)
    assert found.count == count
    assert not found.has_risen, "no fitness lies above the worst of the run"
    assert EqualFitness([replace(EQUAL, worst=0.0), *rows, EQUAL]).has_risen


@pytest.mark.parametrize(("others", "warned"), [(1, [ENOUGH]), (ENOUGH - 1, [ENOUGH]), (ENOUGH, [ENOUGH, 3 * ENOUGH])])
def test_a_spell_is_warned_of_again_only_after_as_many_other_generations(others, warned):
    rows = [*[EQUAL] * ENOUGH, *[OTHER] * others, *[EQUAL] * 2 * ENOUGH]
    found = EqualFitness()
    due = []
    for number, row in enumerate(rows, 1):
        found.add(row)
        due += [number] if found.is_due else []
    assert due == warned
    found = EqualFitness([EQUAL] * ENOUGH)  # as of a run that is continued
    found.add(EQUAL)
    assert not found.is_due


@pytest.mark.wording
def test_enough_of_them_are_warned_of():
    for name, flag in (("gym:CartPole-v1", "--sigma0"), ("function:mine:cost", "scale=")):
        task = replace(STATUS.settings.task, task=name)
        assert describe_equal_fitness(ENOUGH - 1, task, has_risen=False) == ""
        assert flag in describe_equal_fitness(ENOUGH, task, has_risen=False)
        assert flag not in describe_equal_fitness(ENOUGH, task, has_risen=True)
