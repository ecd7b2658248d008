"""What evaluations get of a busy fleet, simulated: whole fleets, FIFO slots, no transport and no real time.

Adding a bad worker never makes a run slower by more than 5 %, and long links leave no slot idle for long.

Tests host_stats.py, speculative_execution.py and worker_selection.py.
"""

import statistics
from functools import cache
from math import inf

import pytest

from dreamfleet.coordinator.dispatch.deficit_round_robin import OUTLIER, DeficitCounter
from tests.support.dispatched import A, B, fleet_of, join, work
from tests.support.fleets import Host, Played

EVEN = {"score": 1.0, "evaluate": 1.0}
CUT = {"score": 0.3, "evaluate": 1.0}  # training episodes are cut by patience
DREAMT = {"score": 0.01, "evaluate": 1.0}


def fleet_of_hosts(workers, slots, jobs, seconds, width=1, **more):
    """So many equal workers without a network between; a generation has one candidate in so many jobs."""
    hosts = [Host(f"w{number}", seconds, slots, width, delay=0.0, bandwidth=inf) for number in range(workers)]
    return Played(*hosts, population=1, episodes=jobs, size=4, **more)


@pytest.mark.parametrize(
    ("workers", "slots", "jobs", "seconds", "width", "episodes"),
    [
        (2, 1, 256, EVEN, 1, 32),  # as it was reported
        (1, 1, 256, EVEN, 1, 32),
        (1, 1, 256, CUT, 1, 32),
        (1, 2, 2048, DREAMT, 256, 10),
        (2, 8, 512, CUT, 1, 40),
        pytest.param(125, 8, 2500, EVEN, 1, 100, marks=pytest.mark.slow),
    ],
    ids=["two slots", "one slot", "one slot, cut", "dreams", "sixteen slots", "a thousand slots"],
)
def test_an_evaluation_is_finished_within_two_generations(workers, slots, jobs, seconds, width, episodes):
    fleet = fleet_of_hosts(
        workers, slots, jobs, seconds, width, evaluations=lambda generation: episodes * (generation % 3 == 0)
    )
    fleet.play(8)
    assert sorted(fleet.done) == [3, 6]
    for generation, done in fleet.done.items():
        assert done <= fleet.closed[generation + 1], "within two generations after the one whose mean it is"


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
@pytest.mark.parametrize("seconds", [EVEN, CUT, DREAMT], ids=["even", "cut", "dreamt"])
@pytest.mark.parametrize(("workers", "slots"), [(1, 1), (2, 2)])
def test_while_evaluations_wait_they_have_their_share_of_the_slots_time(workers, slots, seconds, share):
    """Measured in seconds of the slots; more always wait than the share allows."""
    jobs = min(int(150 * workers * slots / seconds["score"]), 2500)
    fleet = fleet_of_hosts(
        workers, slots, jobs, seconds, evaluations=lambda _: 1000 * workers * slots, evaluation_share=share
    )
    fleet.play(1)
    before = fleet.spent.copy()
    fleet.play(2)
    spent = fleet.spent - before
    job = 2 * workers * slots * seconds["evaluate"] / spent.total()  # what is in hand, at either end
    assert spent["evaluate"] / spent.total() == pytest.approx(share, abs=0.02 + job)


def test_what_was_not_used_is_not_saved_up():
    """After many generations without an evaluation, one takes its share and not the fleet."""
    fleet = fleet_of_hosts(2, 1, 256, EVEN, evaluations=lambda generation: 1000 * (generation == 12))
    fleet.play(13)
    assert 256 / 3 - 4 <= fleet.spent["evaluate"] <= 256 / 3 + 4
    assert fleet.closed[12] - fleet.closed[11] <= 128 * 4 / 3 + 4


def test_without_a_share_they_take_what_is_idle():
    fleet = fleet_of_hosts(
        2, 1, 256, EVEN, evaluations=lambda generation: 32 * (generation % 4 == 0), evaluation_share=0.0
    )
    fleet.play(8)
    assert fleet.spent["evaluate"] <= 4


def test_a_suspended_host_neither_starves_nor_floods():
    share = DeficitCounter(0.25)
    for _ in range(20):
        share.charge(b"s", 1.0, is_background=False, waiting=True)
    share.reserve(b"e")
    share.charge(b"e", 1.0, is_background=True, waiting=True)
    share.reserve(b"f")
    share.charge(b"f", 3600.0, is_background=True, waiting=True)
    for _ in range(4 * OUTLIER):
        share.charge(b"s", 1.0, is_background=False, waiting=True)
    assert share.is_due(1)
    share.charge(b"s", 3600.0, is_background=False, waiting=True)
    went = 0
    while share.is_due(1):
        share.reserve(bytes([went]))
        went += 1
    assert went <= 2 * OUTLIER


def test_a_lost_workers_evaluation_goes_again_at_once():
    fleet = fleet_of(A, jobs=0)
    fleet.jobs.offer([*work(1, "evaluate"), *work(9, generation=1)])
    assert [each.job.kind for send in fleet.dispatch(0.0) for each in send.work] == ["evaluate", "score"]
    fleet.handle_departure(A, 0.1)
    fleet.tick(1.0)
    join(fleet, B, 1.0)
    assert [each.job.kind for send in fleet.dispatch(1.0) for each in send.work] == ["evaluate", "score"]


GENERATIONS, FIRST = 60, 10  # the first few find out how bad it is
FAST = {"narrow": {"width": 1, "turn": 0.0, "row": 0.02}, "wide": {"width": 256, "turn": 0.4, "row": 0.005}}
BAD = {
    "slow link": {"bandwidth": 32_000, "delay": 2.0},
    "thin link": {"bandwidth": 8_000, "delay": 0.05},
    "long link": {"delay": 1.0},
    "slow core": {"slower": 100},
    "rather slow core": {"slower": 3},
    "flapping host": {"lives": 1.5},
    "flapping slow host": {"lives": 2.5, "slower": 10},
    "flapping host behind a slow link": {"lives": 4.0, "bandwidth": 32_000, "delay": 1.0},
}


def made(name, fast, slower=1, **bad):
    return Host(name, {"score": fast["row"] * slower}, width=fast["width"], turn=fast["turn"] * slower, **bad)


def mean_seconds(*hosts, size):
    return statistics.mean(Played(*hosts, size=size).play(GENERATIONS)[FIRST:])


@cache
def seconds_of_a_good_one(fast, size):
    return mean_seconds(made("good", FAST[fast]), size=size)


@pytest.mark.parametrize("size", [pytest.param(64, marks=pytest.mark.long), 900])
@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("fast", FAST)
def test_a_bad_worker_makes_no_run_slower(fast, bad, size):
    alone = seconds_of_a_good_one(fast, size)
    both = mean_seconds(made("good", FAST[fast]), made("bad", FAST[fast], **BAD[bad]), size=size)
    assert both / alone < 1.05


def test_slots_behind_long_links_score_nearly_all_of_the_time():
    hosts = [Host(f"far {number}", {"score": 1.0}, slots=4, delay=0.1) for number in range(3)]
    seconds = statistics.mean(Played(*hosts, population=48, episodes=1).play(10))
    assert 48 / 12 / seconds > 0.93
