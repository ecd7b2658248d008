"""The page's document of live, lost and ended runs."""

from dataclasses import replace
from pathlib import Path

import pytest

from dreamfleet.common.monitoring.status import FailureStatus, WorkerCount
from dreamfleet.coordinator.dashboard.page_state import RunSnapshot, page_state
from tests.support.samples import STATUS


def look(lost=None, folder=None, **changes):
    status = replace(STATUS, **changes)
    lanes = ["9"] * len(status.worker_list)
    return RunSnapshot(status, status.worker_list, lanes, (status.population,), 100.0, lost, folder)


def momentary_values(document):
    tiles = {each["name"]: each["value"] for each in document["tiles"]}
    workers = document["workers"]
    columns = [value for name in ("state", "rate", "leases", "load", "heard") for value in workers[name]]
    return [tiles["throughput"], tiles["fleet"], *columns]


@pytest.mark.parametrize("gone", [{"lost": 101.0}, {"state": "ended"}, {"state": "left"}])
def test_only_a_live_run_shows_momentary_values(gone):
    assert not {"-", None} & set(momentary_values(page_state(look())))
    document = page_state(look(**gone))
    assert set(momentary_values(document)) == {"-", None}
    assert "at the last" in document["fleet"]
    assert document["workers"]["finished"] == page_state(look())["workers"]["finished"], "finished jobs stay"


def test_no_generation_is_open_once_a_run_has_ended_or_only_its_mean_is_driven():
    opened = replace(STATUS.generation, episodes_done=0)
    assert page_state(look(generation=opened))["candidates"]["total"] > 0
    for state in ("ended", "evaluating"):
        assert page_state(look(generation=opened, state=state))["candidates"]["total"] == 0
    assert page_state(look(state="evaluating"))["candidates"]["total"] > 0, (
        "it waits for the evaluation of the last mean"
    )


def test_a_lost_run_with_its_journal_here_shows_the_whole_command():
    assert (
        f"--resume {STATUS.run} --runs-dir /data/runs, with --join"
        in (page_state(look(101.0, Path("/data/runs") / STATUS.run))["sentence"])
    )
    assert f"--resume {STATUS.run}, with --runs-dir and --join" in page_state(look(101.0))["sentence"]


def test_a_refused_worker_is_told_as_long_as_the_run_goes_on():
    refused = {"vm": "no gymnasium"}
    assert page_state(look(refused=refused, failures=()))["troubles"] == ["worker vm was refused: no gymnasium"]
    assert page_state(look(refused=refused, failures=(), state="ended"))["troubles"] == []


def test_failures_and_failed_episodes_are_named():
    failure = FailureStatus("4/0", "evaluate", (20003,), {"host-a": "no road"}, {"host-a": 2})
    document = page_state(look(failures=(failure,), best=replace(STATUS.best, failed=1)))
    assert document["troubles"] == ["the evaluation of generation 4's mean, seed 20003, failed on host-a (2x): no road"]
    reported = next(each for each in document["tiles"] if each["name"] == "reported")
    assert reported["beneath"] == "provisional, generation 4, 16 episodes; 1 more episode failed"


def test_a_worker_that_left_is_shown_with_its_reason_and_is_not_counted_as_silent():
    gone = replace(STATUS.worker_list[0], state="left", reason="no memory\x1b")
    document = page_state(look(worker_list=(gone,), workers=WorkerCount(0, 1, 0, 1)))
    assert document["workers"]["reason"] == ["no memory\\x1b"]
    assert "1 left" in document["fleet"]
    assert "silent" not in document["fleet"]
