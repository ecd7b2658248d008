"""The page's document of live, lost and ended runs, and the columns of its charts. Tests curves.py."""

import math
import re
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path

import pytest

from dreamfleet.common.addons.analysis.learning import efforts_until
from dreamfleet.common.client.equal_fitness import ENOUGH
from dreamfleet.common.client.status import EpisodeProgress, FailureStatus, WorkerCount
from dreamfleet.common.runs.effort import Effort, GenerationEffort
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation
from dreamfleet.coordinator.addons.dashboard.curves import (
    MOST_POINTS,
    RunData,
    curves,
    downsample,
    sampling_step,
)
from dreamfleet.coordinator.addons.dashboard.page_state import RunSnapshot, page_state
from tests.support.samples import CLOSED, STATUS


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


def data(generations, settings=STATUS.settings):
    history = [replace(CLOSED, number=number, mean=float(number)) for number in range(generations)]
    looks = [StoredEvaluation(number, 16, 100.0 + number, 20.0) for number in range(4, generations, 5)]
    return RunData(settings, history, looks, None)


@pytest.mark.parametrize("count", [0, 1, 2, MOST_POINTS, MOST_POINTS + 1, 1234, 5000, 99_999])
def test_a_long_run_is_downsampled_and_keeps_its_ends(count):
    kept = downsample(range(count))
    assert len(kept) <= MOST_POINTS + 1
    assert list(kept[:1]) == list(range(count))[:1]
    assert list(kept[-1:]) == list(range(count))[-1:]
    steps = {after - before for before, after in pairwise(kept)}
    assert steps <= {sampling_step(count), *range(1, sampling_step(count))}


def test_columns_are_equally_long_and_the_band_says_what_it_is():
    drawn = curves(data(10), None)
    assert {len(drawn[name]) for name in ("generation", "mean", "best", "low", "high", "sigma")} == {10}
    assert (drawn["low"][3], drawn["high"][3]) == (max(3.0 - CLOSED.std, CLOSED.worst), 3.0 + CLOSED.std)
    drawn = curves(data(10), {number: (number - 1.0, number + 2.0) for number in range(10)})
    assert (drawn["low"][3], drawn["high"][3]) == (2.0, 5.0)


def test_only_a_dream_has_two_axes_an_empty_chart_says_what_will_come_and_a_world_names_its_episodes():
    plain = curves(data(3), None)
    assert (plain["dreamt"], "1,000" in plain["fitness_axis"]) == (False, True)
    task = replace(STATUS.settings.task, task="dream", temperature=1.5)
    dream = curves(data(3, settings=replace(STATUS.settings, task=task)), None)
    assert (dream["dreamt"], "1,000" in dream["fitness_axis"], "16 seeds" in dream["score_axis"]) == (True, True, True)
    drawn = curves(data(0), None, word="track")
    assert drawn["coming"]
    assert "16 tracks" in drawn["score_axis"]


def test_effort_includes_the_start_and_excludes_confirmations():
    efforts = [
        GenerationEffort(0, False, Effort(10, 0, 0, 36 * 10**8)), GenerationEffort(0, True, Effort(0, 99, 0, 1)),
        GenerationEffort(2, False, Effort(5, 7, 0, 36 * 10**8)),
    ]  # fmt: skip
    spent = list(efforts_until(range(3), Effort(100), efforts))
    assert [each.steps for each in spent] == [110, 110, 122]
    drawn = curves(data(3), None, spent)
    assert (drawn["steps"], drawn["core_hours"]) == ([110, 110, 122], [1.0, 1.0, 2.0])


def test_an_evaluation_of_an_open_generation_has_the_total_effort():
    spent = list(efforts_until(range(3), Effort(), []))
    odd = replace(data(3), evaluations=[StoredEvaluation(2**62, 1, 1.0, 0.0)])
    assert curves(odd, None, spent)["evaluations"]["steps"] == [0]
    assert curves(odd, None, spent)["evaluations"]["error"] == [None], "of one episode"
    empty = RunData(STATUS.settings, [], [], StoredConfirmation(3, 4, 1.0, 0.5, 9))
    assert curves(empty, None, [])["confirmed"]["steps"] == 0


@pytest.mark.parametrize("strange", [math.inf, -math.inf, math.nan, 1.797e308])
def test_a_number_that_cannot_be_drawn_is_a_gap(strange):
    history = [replace(CLOSED, number=0, mean=strange, best=strange)]
    drawn = curves(RunData(STATUS.settings, history, [], None), None)
    for name in ("mean", "low", "high", "best"):
        assert all(value is None or math.isfinite(value) for value in drawn[name])
