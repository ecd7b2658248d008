"""Adding a bad worker never makes a run slower by more than 5 %, and long links leave no slot idle for long: hosts that
take as long as each test says."""

import statistics
from functools import cache

import pytest

from tests.support.fleets import Host, Played

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
