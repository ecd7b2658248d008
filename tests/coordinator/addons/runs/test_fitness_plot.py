"""A run's fitness over its generations, as a picture that is read without its journal.
Tests plot.py and common/addons/analysis/fitness_chart.py."""

from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.addons.analysis.fitness_chart import WINDOW, running_median
from dreamfleet.common.addons.analysis.learning import LearningCurve
from dreamfleet.common.runs.records import StageSettings
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.runs.plot import fitness_figure, learning_figure
from tests.support.journals import change_settings, confirm


def draw(path):
    with RunFolder(path) as run:
        figure = fitness_figure(run)
    figure.draw_without_rendering()
    return figure


def star_of(axes):
    (star,) = [each for each in axes.lines if each.get_marker() == "*"]
    return star


@pytest.mark.parametrize(("name", "last"), [("dream", 11), ("reality", 2), ("hidden", None)])
def test_nothing_is_cut_and_ticks_are_generations(runs, name, last):
    if last is not None:
        confirm(runs / name, last, 4, -30.0, 9.0, 99)
    figure = draw(runs / name)
    drawn = [*figure.legends, *(each for axes in figure.axes for each in (axes.title, axes.yaxis.label))]
    for each in drawn:
        box = each.get_window_extent()
        assert figure.bbox.x0 <= box.x0, each
        assert box.x1 <= figure.bbox.x1, each
        assert figure.bbox.y0 <= box.y0, each
        assert box.y1 <= figure.bbox.y1, each
    panel = figure.axes[-1]
    assert all(float(each).is_integer() for each in panel.get_xticks())
    if last is not None:
        star = star_of(panel)
        assert last < star.get_xdata()[0] < panel.get_xlim()[1]  # beside its evaluation, within the panel
        assert star.get_zorder() > max(each.get_zorder() for each in panel.lines if each is not star)
        assert any("-30.0 ± 4.5" in each.get_text() for each in figure.legends[0].get_texts())


def test_a_dreams_fitness_and_its_score_in_reality_share_no_axis(runs):
    assert len(draw(runs / "dream").axes) == 2
    (axes,) = draw(runs / "reality").axes
    assert "60" in axes.get_ylabel()


def test_few_episodes_a_candidate_are_said_to_differ_from_one_generation_to_the_next(runs):
    with RunFolder(runs / "hidden") as run:
        assert run.settings.episodes == 1
    assert len(draw(runs / "hidden").axes[0].texts) == 1


def test_a_running_median_is_no_lucky_generations_and_crosses_no_stage():
    values = np.full(40, 10.0)
    values[20:] = 50.0
    values[[7, 30]] = 1000.0
    smooth = running_median(values, (0, 20))
    assert (smooth[:20] == 10).all()
    assert (smooth[20:] == 50).all()
    assert running_median(values[: 2 * WINDOW - 1]) is None


def test_a_confirmed_score_at_the_end_of_a_learning_curve_is_within_the_panel(runs):
    confirm(runs / "reality", 2, 4, -30.0, 9.0, 99)
    with RunFolder(runs / "reality") as run:
        figure = learning_figure([LearningCurve.of(run)], None)
    figure.draw_without_rendering()
    for axes in figure.axes:
        assert axes.get_xlim()[0] < star_of(axes).get_xdata()[0] < axes.get_xlim()[1]
    box = figure.legends[0].get_window_extent()
    assert figure.bbox.x0 <= box.x0
    assert box.x1 <= figure.bbox.x1


def test_a_line_has_a_gap_where_the_search_goes_on_elsewhere(runs):
    ends = StageSettings(generations=4, score=1e6)
    stages = ends, replace(ends, restart=True), StageSettings(sigma0=0.1)
    change_settings(runs / "dream", lambda settings: replace(settings, stages=stages, evaluate_every=2))
    for line in (each for panel in draw(runs / "dream").axes for each in panel.lines):
        if len(line.get_xdata()) > 2:
            found = np.array(line.get_xdata(), dtype=float)
            assert [found[place + 1] for place in np.flatnonzero(np.isnan(found))] in ([4, 8], [5, 9])


def test_a_generation_between_two_without_a_fitness_is_a_dot(runs, monkeypatch):
    monkeypatch.setattr(RunFolder, "unscored_generations", lambda _: {1})
    with RunFolder(runs / "reality") as run:
        line = fitness_figure(run).axes[0].lines[0]
    assert (line.get_marker(), line.get_markevery()) == ("o", [0, 2])
