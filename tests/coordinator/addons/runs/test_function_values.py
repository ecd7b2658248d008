"""What people read of a function that is minimised: its own values, where a run has fitness.
Tests common/protocol/function_values.py and coordinator/addons/dashboard/compared_runs.py."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.addons.analysis.comparison import ComparedRun, are_comparable
from dreamfleet.common.addons.analysis.learning import LearningCurve
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.runs.episode_results import EpisodeResult
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration, in_values
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.dashboard.compared_runs import compare_runs
from dreamfleet.coordinator.addons.dashboard.stored_runs import describe_run, list_runs
from dreamfleet.coordinator.addons.runs.plot import fitness_figure, learning_figure
from dreamfleet.coordinator.addons.status.status_panel import panel_lines
from dreamfleet.worker.addons.evaluation.evaluation_report import EvaluationReport
from dreamfleet.worker.addons.evaluation.known_score import find_known_score
from dreamfleet.worker.addons.verification.candidate_verb import _in_values
from dreamfleet.worker.addons.verification.replay import ReplayedEpisode
from dreamfleet.worker.addons.verification.reproduction import Reproduction
from tests.support.journals import change_journal, change_settings
from tests.support.processes import printed
from tests.support.samples import SPEC, STATUS
from tests.support.tables import cells

OPTIONS = Objective.of({"dimension": 39, "x0": 0, "minimise": True}).options  # as many as the recorded runs search
MINIMISED = replace(SPEC, task="function:mine:cost", options=OPTIONS, bundle="", horizon=1, patience=0)


@pytest.fixture
def minimised(runs):
    """Two runs of a function, whose values fall from 1,000 to 1 in steps of ten."""

    def of_function(settings):
        return replace(settings, task=replace(settings.task, task=MINIMISED.task, options=OPTIONS))

    for run, factor in ((runs / "reality", 1.0), (runs / "hidden", 0.5)):
        change_settings(run, of_function)
        numbers = change_journal(run, "SELECT number FROM generation WHERE mean IS NOT NULL")
        for (number,) in numbers:
            value = factor * 1000.0 / 10 ** (3 * number / (len(numbers) - 1))
            query = "UPDATE generation SET mean = ?, std = ?, best = ?, worst = ? WHERE number = ?"
            change_journal(run, query, -value, value / 4, -value / 2, -2 * value, number)
    return runs


def test_records_have_the_functions_values_and_others_stay():
    closed = StoredGeneration(3, -2.0, 0.5, -1.0, -3.0, 0.1, 10, 1.0)
    found = in_values(closed, MINIMISED)
    assert (found.mean, found.best, found.worst, found.std) == (2.0, 1.0, 3.0, 0.5)
    assert in_values(closed, SPEC) is closed
    assert in_values(None, MINIMISED) is None
    assert f"{value_of(0.0, MINIMISED):g}" == "0"
    assert in_values(StoredEvaluation(3, 4, -2.0, 1.0), MINIMISED).mean == 2.0


def test_the_plots_fall_on_a_logarithmic_axis_that_says_so(minimised):
    with RunFolder(minimised / "reality") as run:
        axes = fitness_figure(run).axes[0]
        learning_figure([LearningCurve.of(run)], None)
    assert axes.get_yscale() == "log"
    mean = axes.lines[0].get_ydata()
    assert (mean[0], mean[-1]) == pytest.approx((1000, 1))


def test_the_verbs_print_values_and_json_has_fitness(minimised):
    rows = {row[0]: row for row in map(cells, printed("runs", "list").splitlines())}
    assert "1.0" in rows["reality"]
    rows = {row["run"]: row for row in json.loads(printed("runs", "list", "--json"))}
    assert rows["reality"]["mean"] == -1.0
    assert "-1,000" not in printed("runs", "show", "reality")
    printed("compare", "reality", "hidden")


def test_the_page_has_values_and_the_kind_of_axis(minimised):
    curves = describe_run(minimised, "reality")["curves"]
    assert curves["log"]
    assert curves["mean"][0] == pytest.approx(1000)
    assert curves["best"][0] == pytest.approx(500)
    assert next(row for row in list_runs(minimised) if row["run"] == "reality")["mean"] == 1.0
    assert compare_runs(minimised, "reality", "hidden")["problem"] == ""


def test_a_smaller_value_is_the_better_one_of_two_runs(minimised):
    with RunFolder(minimised / "reality") as run:
        side = ComparedRun.of(run)
    assert side.minimised
    other = replace(side, settings=replace(side.settings, task=SPEC))
    assert are_comparable([side, side])
    assert not are_comparable([side, other])


def test_the_panel_says_values():
    settings = replace(STATUS.settings, task=MINIMISED)
    closed = [replace(STATUS.last, number=n, mean=-(10.0 ** (3 - n)), best=-0.5, worst=-2000.0) for n in range(4)]
    status = replace(STATUS, settings=settings, last=closed[-1], recent=tuple(closed))
    text = " ".join(" ".join(line.plain for line in panel_lines(status, 78)).split())
    assert re.search(r"\b1\.0.*2,000.*0\.5.*0.*3", text)
    assert "-2,000" not in text


MAXIMISED = Objective.of({"dimension": 39, "x0": 0}).options
REPORT = EvaluationReport(
    "a1", "cd" * 32, MINIMISED.task, MINIMISED.task, "", "x86_64", "0.1.0", 1.0,
    tuple(EpisodeResult(seed, score, 1) for seed, score in ((1, -2.0), (2, -4.0))), judge="mine", options=OPTIONS,
)  # fmt: skip


def numbers(text):
    return [float(each) for each in re.findall(r"-?\b\d+\.\d+", text)]


@pytest.mark.parametrize("shown", [3.0, -3.0])
def test_texts_of_an_evaluation_show_values_and_its_figures_are_fitness(tmp_path, shown):
    report = REPORT if shown > 0 else replace(REPORT, options=MAXIMISED)
    assert (report.results.mean, report.results.worst, report.results.best) == (-3.0, -4.0, -2.0)
    assert json.loads(report.to_json())["mean"] == -3.0
    texts = repr(report.results), report.describe(), Reproduction(report, report).description
    assert [numbers(each)[0] for each in texts] == [shown] * 3
    costlier = replace(report, drives=tuple(replace(each, score=each.score - each.seed) for each in report.drives))
    paths = tmp_path / "one.json", tmp_path / "other.json"
    for path, each in zip(paths, (report, costlier), strict=True):
        path.write_text(each.to_json())
    *_, difference = printed("compare", *paths).splitlines()
    assert numbers(difference)[0] == (1.5 if shown > 0 else -1.5)


@pytest.mark.parametrize("shown", [3.0, -3.0])
def test_a_controllers_known_score_and_a_replayed_candidate_are_values(shown):
    options = OPTIONS if shown > 0 else MAXIMISED
    provenance = {"validation_mean": -3.0, "validation_error": 0.5, "validation_episodes": 2}
    controller = Controller(ControllerShape(1, 1), np.ones(2, np.float32), MINIMISED.task, "", provenance, options)
    assert find_known_score(controller).mean == shown
    found = _in_values(ReplayedEpisode(0, 1, -3.0, -3.0, "", own=True), replace(MINIMISED, options=options))
    assert (found.stored, found.replayed, found.same) == (shown, shown, True)
