"""What hosts did over time, from what a journal keeps."""

import pytest

from dreamfleet.common.runs.records import StoredEvent, WorkerEffort
from dreamfleet.coordinator.addons.dashboard.host_history import BINS, MOST_HOSTS, host_history

TIMES = {0: (1000.0, 1060.0), 1: (1060.0, 1120.0)}


def work(worker="desk/0a", generation=0, kind="score", confirming=False, steps=600.0, seconds=30.0):
    return WorkerEffort(worker, generation, kind, confirming, 6, steps, seconds)


def event(at, what="", worker="", incarnation=1):
    return StoredEvent(at, incarnation, "as it was noted", what, worker)


def joined(worker, at=1000.0, incarnation=1):
    return event(at, "joined", worker, incarnation)


def only(found):
    (host,) = found["hosts"]
    return host


def test_steps_count_evenly_over_the_time_of_their_generation():
    found = host_history([work(), work(generation=1, steps=1200.0)], TIMES, [], None)
    assert (found["since"], found["width"]) == (1000.0, 1.0)
    assert only(found)["rate"] == pytest.approx([10.0] * 60 + [20.0] * 60)
    assert (only(found)["results"], only(found)["steps"], only(found)["seconds"]) == (12, 1800.0, 60.0)


def test_a_worker_that_came_and_worked_is_one_whatever_its_name():
    for worker in ("desk/0a", "desk"):
        found = host_history([work(worker)], TIMES, [joined(worker)], None)
        assert (only(found)["host"], only(found)["lives"]) == ("desk", 1)


def test_no_step_is_lost_whatever_the_clocks_said():
    times = {0: (1000.0, 900.0), 1: (1e9, None), 2: (5.0, 7.0)}
    rows = [work(generation=each, kind=kind) for each in (0, 1, 2, 7) for kind in ("score", "evaluate", "collect")]
    rows.append(work(kind="evaluate", confirming=True))
    found = host_history(rows, times, [], 800.0)
    assert sum(only(found)["rate"]) * found["width"] == pytest.approx(13 * 600.0, rel=1e-2)


def test_a_mean_is_evaluated_until_the_next_ones_turn():
    rows = [work(kind="evaluate"), work(generation=1, kind="evaluate")]
    rate = only(host_history(rows, TIMES, [], 1180.0))["rate"]
    assert rate[:40] == [0.0] * 40, "not while its generation was open"
    assert sum(rate[40:80]) * 1.5 == pytest.approx(600.0), "until that of generation 1 began"
    assert sum(rate[80:]) * 1.5 == pytest.approx(600.0)


def test_workers_are_there_from_when_they_come_until_they_go():
    events = [
        joined("desk/0a"), joined("desk/0b", 1010.0), joined("rack/0c", 1010.0),
        event(1030.0, "silent", "desk/0a"),
        event(1040.0, "back", "desk/0a"), event(1050.0, "left", "rack/0c"),
        event(1055.0),
    ]  # fmt: skip
    found = host_history([], TIMES, events, 1120.0)
    hosts = {each["host"]: each for each in found["hosts"]}
    assert hosts["desk"]["present"] == [(1000.0, 1030.0), (1010.0, 1120.0), (1040.0, 1120.0)]
    assert hosts["rack"]["present"] == [(1010.0, 1050.0)]
    assert (hosts["desk"]["lives"], hosts["desk"]["there"]) == (2, 120.0)
    assert hosts["desk"]["workers"][5:45:10] == [1.0, 2.0, 2.0, 1.0]
    assert [each["at"] for each in found["events"]] == [1050.0, 1040.0, 1030.0, 1010.0, 1010.0, 1000.0], (
        "the newest first"
    )


def test_a_killed_coordinators_workers_are_there_until_its_last_sign():
    events = [joined("desk/0a"), event(5000.0, incarnation=2), joined("desk/0a", 5010.0, 2)]
    present = only(host_history([], TIMES, events, 5100.0))["present"]
    assert present == [(1000.0, 1120.0), (5010.0, 5100.0)]


def test_a_run_without_any_sign_is_empty_and_a_strange_one_bounded():
    assert host_history([], {}, [], None)["hosts"] == []
    many = host_history(
        [work(f"host-{each}/0a") for each in range(MOST_HOSTS + 5)],
        TIMES,
        [StoredEvent(1000.0, 1, "\x1b[2J", "joined", "\x1b[2J/0a")],
        None,
    )
    assert (len(many["hosts"]), many["more"]) == (MOST_HOSTS, 6)
    assert "\x1b" not in str(many["events"])
    assert all(len(each["rate"]) == len(each["workers"]) == BINS for each in many["hosts"])
