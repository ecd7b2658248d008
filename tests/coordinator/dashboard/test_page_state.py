"""What the page shows of a live run, and of one that nobody serves any more."""

from dataclasses import replace
from pathlib import Path

import pytest

from dreamfleet.coordinator.dashboard.page_state import RunSnapshot, page_state
from tests.support.samples import STATUS


def look(lost=None, folder=None, **changes):
    status = replace(STATUS, **changes)
    lanes = ["9"] * len(status.worker_list)
    return RunSnapshot(status, status.worker_list, lanes, (status.population,), 100.0, lost, folder)


def of_a_moment(told):
    tiles = {each["name"]: each["value"] for each in told["tiles"]}
    workers = told["workers"]
    columns = [value for name in ("state", "rate", "leases", "load", "heard") for value in workers[name]]
    return [tiles["throughput"], tiles["fleet"], *columns]


@pytest.mark.parametrize("gone", [{"lost": 101.0}, {"state": "ended"}, {"state": "left"}])
def test_what_was_true_for_a_moment_is_told_of_a_live_run_alone(gone):
    assert not {"-", None} & set(of_a_moment(page_state(look())))
    told = page_state(look(**gone))
    assert set(of_a_moment(told)) == {"-", None}
    assert "at the last" in told["fleet"]
    assert told["workers"]["finished"] == page_state(look())["workers"]["finished"], "what was done stays"


def test_no_generation_is_open_once_a_run_has_ended_or_only_its_mean_is_driven():
    opened = replace(STATUS.generation, episodes_done=0)
    assert page_state(look(generation=opened))["candidates"]["total"] > 0
    for state in ("ended", "evaluating"):
        assert page_state(look(generation=opened, state=state))["candidates"]["total"] == 0
    assert page_state(look(state="evaluating"))["candidates"]["total"] > 0, (
        "it waits for the evaluation of the last mean"
    )


def test_a_lost_run_whose_journal_lies_here_is_told_with_its_whole_command():
    assert (
        f"--resume {STATUS.run} --runs-dir /data/runs, with --join"
        in (page_state(look(101.0, Path("/data/runs") / STATUS.run))["sentence"])
    )
    assert f"--resume {STATUS.run}, with --runs-dir and --join" in page_state(look(101.0))["sentence"]
