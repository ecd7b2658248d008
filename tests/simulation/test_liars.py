"""Fleets with liars, by the virtual clock; `python -m tests.simulation.liars` measures many.

Tests coordinator/jobs/checks.py and coordinator/run/verification.py.
"""

from dataclasses import replace
from unittest.mock import patch

import pytest

from dreamfleet.common.errors import JournalError
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.run import recall
from dreamfleet.coordinator.run.generations import Generations
from dreamfleet.coordinator.storage.recall_records import RecallRecords
from tests.simulation.liars import by_chance, for_a_candidate, one_flip, play_with, shape_of
from tests.simulation.mutants import MUTANTS
from tests.simulation.schedule import Fault, Schedule
from tests.simulation.violation import Violation
from tests.simulation.world import play

SHAPE = replace(shape_of(3, 1.0, 1), racing=False, generations=3, population=4, evaluate_every=1)
RACE = {"racing": True, "episodes": 3}
OWN = frozenset({0})  # the coordinator's own host
HALF = {1: by_chance(0.5, 1)}


def fleet(workers, share=1.0, faults=(), **more):
    return Schedule(replace(SHAPE, workers=workers, verify=share, **more), faults)


def away(worker, seconds):
    """A worker that comes late."""
    return (Fault(0.02, "kill_worker", worker, seconds, 0.0),)


def assert_barred(schedule, lies=HALF, trusted=frozenset(), bars=None):
    """Whoever lies is barred, nobody else, and what counts is true."""
    found = play_with(schedule, lies, trusted, bars=bars)
    assert found.barred == {f"w{host}" for host in lies}
    assert found.is_honest


@pytest.mark.parametrize("lie", [(by_chance, 0.5, 1), (for_a_candidate, 0.25, 4, 1), (one_flip, 3)])
@pytest.mark.parametrize("workers", [2, 3, 4])
def test_who_differs_is_barred_and_what_counts_is_true(lie, workers):
    make, *given = lie
    assert_barred(fleet(workers), {1: make(*given)}, OWN)


@pytest.mark.parametrize("lie", [by_chance(0.5, 1), for_a_candidate(0.25, 4, 1)])
@pytest.mark.parametrize("seed", range(4))
def test_a_race_that_lies_decided_is_decided_again(lie, seed):
    assert_barred(fleet(3, 0.5, run_seed=seed, **RACE), {1: lie}, OWN)


@pytest.mark.parametrize(
    ("schedule", "lies", "trusted"),
    [
        (fleet(3, 0.3, generations=6, faults=away(1, 6.0)), HALF, ()),
        (fleet(3), HALF, ()),
        (fleet(3, faults=away(2, 40.0)), HALF, ()),
        (fleet(3), {0: by_chance(0.5, 0)}, OWN),
        (fleet(3, first_stage=2, first_score=1.4, anew=True), HALF, ()),
    ],
    ids=[
        "a late liar",
        "no trusted host",
        "two held until a third comes",
        "the coordinator's own host",
        "a stage by score",
    ],
)
def test_whoever_it_is_a_third_host_decides_and_the_run_goes_back_to_where_it_came(schedule, lies, trusted):
    assert_barred(schedule, lies, trusted)


ALIKE = dict.fromkeys((1, 2, 3), by_chance(0.3, 1))  # one person's hosts, which confirm each other
SEATS = {0: 1, 1: 2, 2: 2, 3: 2, 4: 3}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("share", [0.5, 1.0])
@pytest.mark.parametrize("race", [{}, RACE])
def test_hosts_that_share_a_join_file_have_one_voice_however_many_they_are(seed, share, race):
    found = play_with(fleet(5, share, run_seed=seed, generations=6, **race), ALIKE, seats=SEATS)
    assert found.barred == found.liars, "with the first, all names of its join file go"
    assert found.is_honest


def test_in_an_open_fleet_the_most_hosts_decide_also_if_they_lie_alike():
    assert any(not play_with(fleet(5, run_seed=seed), ALIKE).is_honest for seed in range(4))


def test_memory_that_fails_once_is_found_between_two_hosts_without_a_trusted_host():
    assert_barred(fleet(2), {1: one_flip(3)})


@pytest.mark.parametrize("race", [{}, RACE])
@pytest.mark.parametrize("at", [0.5, 2.0, 3.5])
def test_a_host_that_the_operator_bars_is_recalled_though_nothing_is_checked(at, race):
    kills = tuple(Fault(moment, "kill_coordinator", 0, 0.3, 7) for moment in (at, at + 0.6))
    assert_barred(fleet(3, 0.0, faults=kills, generations=6, **race), bars={1: at})


@pytest.mark.parametrize("step", range(0, 60, 3))
def test_a_coordinator_that_is_killed_about_a_recall_recalls_all(step):
    assert_barred(
        fleet(3, faults=tuple(Fault(at, "kill_coordinator", 0, 0.3, step) for at in (1.0, 1.6, 2.2, 2.8, 3.4)))
    )


def test_an_honest_fleet_loses_no_more_than_the_share_and_accuses_nobody():
    plays = [play_with(Schedule(shape_of(5, 0.1, seed), ()), {}) for seed in range(3)]
    assert all(found.is_honest and not found.barred for found in plays)
    scored, counted, checked = (sum(getattr(each, name) for each in plays) for name in ("scored", "counted", "checked"))
    assert 0.05 * counted < checked < 0.15 * counted
    assert scored - counted - checked <= 0.02 * counted + 3 * 5, "beside the copies that measure newcomers"


@pytest.mark.parametrize(
    ("target", "name", "forgetful"),
    [
        (recall, "_first_affected", lambda brought, settings: None),
        (RecallRecords, "recall", lambda self, hosts: 0),
        (Generations, "replay", lambda self, number: self._strategy.state()),
    ],
)
def test_a_recall_that_forgets_a_part_is_noticed(target, name, forgetful):
    """Each forgets one thing: where the run is another, its results, the strategy's state."""

    def is_noticed(seed):
        schedule = fleet(3, 0.3, run_seed=seed, generations=6, faults=away(1, 6.0))  # its first results are late
        try:
            return not play_with(schedule, {1: by_chance(0.3, seed)}).is_honest
        except (Violation, JournalError):
            return True

    with patch.object(target, name, forgetful):
        assert any(map(is_noticed, range(4)))


@pytest.mark.parametrize(
    ("name", "forgetful"),
    [("surplus", []), ("fitness", MUTANTS["generation_counts_what_its_race_does_not_want"].replacement)],
)
def test_a_recall_that_forgets_what_a_race_wants_is_noticed(name, forgetful):
    with patch.object(Generation, name, forgetful):
        plays = [play_with(fleet(3, 0.5, run_seed=seed, **RACE), {1: by_chance(0.5, 1)}) for seed in range(4)]
    assert not all(found.is_honest for found in plays)


def test_a_lone_host_of_its_class_does_not_hold_up_its_run():
    assert play(fleet(1)).violation is None
