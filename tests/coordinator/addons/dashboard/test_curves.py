"""The columns of the charts: bounded in number, and aligned."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest

from dreamfleet.common.runs.effort import Effort, GenerationEffort
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation
from dreamfleet.coordinator.addons.dashboard.curves import (
    MOST_POINTS,
    RunData,
    cumulative_effort,
    curves,
    downsample,
    sampling_step,
)
from tests.support.samples import CLOSED, STATUS


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
    spent = cumulative_effort(Effort(100), efforts, 3)
    assert [each.steps for each in spent] == [110, 110, 122]
    drawn = curves(data(3), None, spent)
    assert (drawn["steps"], drawn["core_hours"]) == ([110, 110, 122], [1.0, 1.0, 2.0])


def test_an_evaluation_of_an_open_generation_has_the_total_effort():
    spent = cumulative_effort(Effort(), [], 3)
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
