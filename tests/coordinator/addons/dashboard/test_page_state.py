"""The page's document of live, lost and ended runs."""

import re
from dataclasses import fields, replace
from pathlib import Path

import pytest

from dreamfleet.common.client.equal_fitness import ENOUGH
from dreamfleet.common.client.status import EpisodeProgress, FailureStatus, WorkerCount
from dreamfleet.coordinator.addons.dashboard.page_state import RunSnapshot, page_state
from tests.support.samples import STATUS


def shown(lost=None, folder=None, word="seed", **changes):
    status = replace(STATUS, **changes)
    lanes = ["9"] * len(status.worker_list)
    return page_state(RunSnapshot(status, status.worker_list, lanes, (status.population,), 100.0, lost, folder, word))


def tiles_of(document):
    return {each["name"]: each for each in document["tiles"]}


def momentary_values(document):
    tiles, workers = tiles_of(document), document["workers"]
    columns = [value for name in ("state", "rate", "leases", "load", "heard") for value in workers[name]]
    return {tiles["throughput"]["value"], tiles["fleet"]["value"], *columns}


@pytest.mark.parametrize("gone", [{"lost": 101.0}, {"state": "ended"}, {"state": "left"}])
def test_only_a_live_run_shows_momentary_values(gone):
    assert not {"-", None} & momentary_values(shown())
    document = shown(**gone)
    assert momentary_values(document) == {"-", None}
    assert document["workers"]["finished"] == shown()["workers"]["finished"], "finished jobs stay"


def test_no_generation_is_open_once_a_run_has_ended_or_only_its_mean_is_driven():
    opened = replace(STATUS.generation, episodes_done=0)
    assert shown(generation=opened)["candidates"]["total"] > 0
    for state in ("ended", "evaluating"):
        assert shown(generation=opened, state=state)["candidates"]["total"] == 0
    assert shown(state="evaluating")["candidates"]["total"] > 0, "it waits for the evaluation of the last mean"


def test_a_lost_run_with_its_journal_here_shows_the_whole_command():
    here = shown(101.0, Path("/data/runs") / STATUS.run)["sentence"]
    assert re.search(f"--resume {STATUS.run} --runs-dir /data/runs.*--join", here)
    assert re.search(f"--resume {STATUS.run}.*--runs-dir.*--join", shown(101.0)["sentence"])


def test_troubles_are_failures_generations_of_one_fitness_and_a_worker_that_is_refused_as_long_as_the_run_goes_on():
    assert len(shown(failures=(), equal=ENOUGH)["troubles"]) == 1
    assert shown(failures=(), equal=ENOUGH - 1)["troubles"] == []
    refused = {"vm": "no gymnasium"}
    (trouble,) = shown(refused=refused, failures=())["troubles"]
    assert re.search("vm.*no gymnasium", trouble)
    assert shown(refused=refused, failures=(), state="ended")["troubles"] == []
    failure = FailureStatus("4/0", "evaluate", (20003,), {"host-a": "no road"}, {"host-a": 2})
    document = shown(failures=(failure,), best=replace(STATUS.best, failed=1))
    (trouble,) = document["troubles"]
    assert re.search(r"\b4\b.*20003.*host-a.*2.*no road", trouble)
    assert re.search(r"\b4\b.*16 seeds.*1 ", tiles_of(document)["score"]["beneath"])


def test_a_running_run_says_each_fact_once():
    assert shown(state="running")["sentence"] == "", "the open generation's card says it"
    paused = shown(state="paused", why="by hand")
    assert (paused["state"], paused["sentence"]) == ("paused", "By hand")


def test_redundant_work_is_one_line_unless_it_is_not_zero():
    nothing = replace(STATUS.waste, **{each.name: 0 for each in fields(STATUS.waste)})
    assert shown(waste=nothing, dropped={"malformed": 0})["redundant"] == {"text": "none", "rows": []}
    some = shown(waste=replace(nothing, silences=3), dropped={"bad\x1b": 2})["redundant"]
    assert "0.0%" in some["text"]
    assert [count for _, count in some["rows"]] == ["3", "2"]
    assert some["rows"][1][0].endswith("bad\\x1b")


def test_the_score_before_the_first_evaluation_says_when_it_comes_and_then_its_episodes_as_the_world_calls_them():
    settings = replace(STATUS.settings, evaluate_every=10)
    score = tiles_of(shown(best=None, confirmed=None, settings=settings))["score"]
    assert (score["value"], score["beneath"].split()[-1]) == ("-", "9")
    document = shown(word="track", evaluating=EpisodeProgress(3, 16))
    assert "16 tracks" in document["evaluation"][0]
    assert "16 tracks" in tiles_of(document)["score"]["beneath"]


def test_a_worker_that_left_is_shown_with_its_reason_and_is_not_counted_as_silent():
    gone = replace(STATUS.worker_list[0], state="left", reason="no memory\x1b")
    document = shown(worker_list=(gone,), workers=WorkerCount(0, 1, 0, 1))
    assert document["workers"]["reason"] == ["no memory\\x1b"]
    assert "1 left" in document["fleet"]
    assert "silent" not in document["fleet"]
