"""What runs learnt from what they spent, as data; their curves and fitness as pictures; what differs between them.
Tests plot.py, common/runs/effort.py, common/addons/analysis/comparison.py, common/addons/analysis/fitness_chart.py,
common/addons/analysis/learning.py and dreamfleet/experiments/verbs/compare.py."""

import html
import json
import re
import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.addons.analysis.comparison import ComparedRun, at_equal_budget, differing_settings
from dreamfleet.common.addons.analysis.fitness_chart import WINDOW, running_median
from dreamfleet.common.addons.analysis.learning import LearningCurve, Point
from dreamfleet.common.runs.effort import START_EFFORT, Effort
from dreamfleet.common.runs.records import StageSettings
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.seeds import CONFIRMING_OFFSET, VALIDATION
from dreamfleet.common.worlds.shipped import WORLDS
from dreamfleet.coordinator.addons.runs.plot import fitness_figure, learning_figure, save_figure
from tests.support.journals import change_journal, change_settings, confirm
from tests.support.processes import call_here, printed
from tests.support.tables import cells

FIRST, LAST = Effort(10**5, 10**4, 0, 10**9), Effort(2 * 10**5, 9 * 10**4, 0, 3 * 10**9)
PAPERS_NAME = WORLDS["car-racing"].published.source
LOOK = Point(FIRST, 310.0, 80.0)
CURVE = LearningCurve("night", "car-racing", (LOOK,), Point(LAST, 680.0, 20.0), LOOK, LAST)


def curve_of(path):
    with RunFolder(path) as run:
        return LearningCurve.of(run)


def drawn(curve, published, path):
    """What a picture spells: letters are shapes, with their text beside them."""
    save_figure(learning_figure([curve], published), path)
    return html.unescape(path.read_text())


@pytest.mark.parametrize(("name", "kind"), [("reality", "driven"), ("dream", "dreamt")])
def test_each_evaluation_stands_over_all_that_was_spent_up_to_it(runs, name, kind):
    curve = curve_of(runs / name)
    with RunFolder(runs / name) as run:
        evaluations = run.evaluations()
    assert [each.score for each in curve.points] == [each.mean for each in evaluations]
    query = "SELECT kind, sum(steps) FROM result WHERE generation <= ? GROUP BY 1"
    for evaluation, point in zip(evaluations, curve.points, strict=True):
        steps = dict(change_journal(runs / name, query, evaluation.generation))
        assert (getattr(point.effort, kind), point.effort.judged) == (steps["score"], steps["evaluate"])
        assert point.effort.steps == steps["evaluate"] + (steps["score"] if kind == "driven" else 0)
        assert 0 < point.effort.microseconds <= curve.total.microseconds
    assert (curve.world, curve.confirmed) == ("car-racing", None)


def test_what_was_spent_on_its_start_counts_for_a_run(runs):
    before = curve_of(runs / "reality")
    spent = '{"driven": 1000, "dreamt": 7}'
    change_journal(runs / "reality", "INSERT INTO run VALUES (?, ?)", START_EFFORT, spent)
    after = curve_of(runs / "reality")
    assert after.points[0].effort == before.points[0].effort + Effort(1000, 0, 7)
    assert after.total == before.total + Effort(1000, 0, 7)


def test_a_run_that_goes_on_meanwhile_is_drawn_as_of_one_moment(runs, tmp_path, monkeypatch):
    """The verb reads points, spending and evaluations one after another."""
    total = RunFolder.total_effort

    def judge_another(run):
        copied = "vector, episodes, mean, std, failed, checksum FROM evaluation LIMIT 1"
        change_journal(runs / "reality", f"INSERT INTO evaluation SELECT 999, {copied}")
        return total(run)

    change_journal(runs / "reality", "PRAGMA journal_mode = WAL")
    monkeypatch.setattr(RunFolder, "total_effort", judge_another)
    printed("runs", "plot", "reality", "--kind", "learning", "--out", tmp_path / "a.png")


@pytest.mark.parametrize(
    ("words", "made"),
    [("hidden", "hidden-fitness.png"), ("reality", "reality-fitness.png"),
     ("reality --kind learning", "reality-learning.png"), ("reality dream", "reality-dream-learning.png"),
     ("reality --out pictures/curve.png", "pictures/curve.png")],
)  # fmt: skip
def test_the_kind_and_the_file_follow_from_the_runs_or_what_is_named(runs, tmp_path, monkeypatch, words, made):
    monkeypatch.chdir(tmp_path)
    assert printed("runs", "plot", *words.split()) == f"{made}\n"
    assert (tmp_path / made).read_bytes().startswith(b"\x89PNG")


def test_runs_of_several_worlds_are_drawn_with_a_note_and_short_ones_without_marks(runs, tmp_path):
    words = "runs", "plot", "reality", "dream", "--out", tmp_path / "a.svg"
    printed(*words)
    assert PAPERS_NAME not in html.unescape((tmp_path / "a.svg").read_text())
    change_journal(runs / "reality", "UPDATE run SET value = replace(value, 'car-racing', 'gym:Other-v0')")
    code, _, noted = call_here(*words)
    assert (code, "car-racing, gym:Other-v0" in noted) == (0, True)
    assert "reality in gym:Other-v0: " in html.unescape((tmp_path / "a.svg").read_text())


def test_a_picture_names_runs_axes_and_published_marks_and_equal_ones_are_equal_files(tmp_path):
    one, other = (drawn(CURVE, WORLDS["car-racing"].published, tmp_path / name) for name in ("a.svg", "b.svg"))
    assert one == other
    for said in ("night: 290k", "core-hours", PAPERS_NAME, "823"):
        assert said in one, said


def test_a_published_score_whose_steps_are_unknown_is_a_line_across_both_pictures(tmp_path):
    published = WORLDS["takecover"].published
    text = drawn(CURVE, published, tmp_path / "a.svg")
    assert published.source in text
    assert "night: 290k" in text


@pytest.mark.parametrize(
    ("words", "named"),
    [("reality --out a.gif", ".png"), ("reality dream --kind fitness", "fitness"), ("nowhere", "'nowhere'"),
     ("reality hidden", "hidden")],
)  # fmt: skip
def test_what_cannot_be_drawn_says_why(runs, words, named):
    code, _, error = call_here("runs", "plot", *words.split())
    assert code != 0
    assert named in error


@pytest.mark.parametrize(("times", "is_log"), [(20, True), (3, False)])
def test_an_axis_is_logarithmic_only_over_a_decade_and_says_so(tmp_path, times, is_log):
    points = tuple(Point(Effort(driven=steps, microseconds=10**6), 500.0, 9.0) for steps in (1000, times * 1000))
    curve = replace(CURVE, points=points, confirmed=None, reported=None)
    assert ("(log scale)" in drawn(curve, None, tmp_path / "a.svg")) == is_log


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


RESULT = "INSERT INTO result VALUES (?, 'evaluate', ?, 0, ?, ?, ?, 10, 0.1, 'w', 'f', 1, 'c', NULL)"


def confirm_by(path, scores):
    """As a run ends: its last evaluated mean on fresh tracks."""
    with RunFolder(path) as run:
        last, closed = run.evaluations()[-1].generation, len(run.history())
    for episode, score in enumerate(scores, CONFIRMING_OFFSET):
        digest = f"{path.name}{episode}".encode()
        change_journal(path, RESULT, digest, last, episode, VALIDATION.start + episode, score)
    confirm(path, last, len(scores), sum(scores) / len(scores), 1.0, closed)


def side(path):
    with RunFolder(path) as run:
        return ComparedRun.of(run)


def test_settings_that_differ_are_named_and_others_are_not(runs):
    dream, reality = side(runs / "dream"), side(runs / "reality")
    found = differing_settings([dream, reality])
    assert found["seed"] == [12, 11]
    assert found["task.task"] == ["dream", "car-racing"]
    assert "sigma0" not in found
    assert differing_settings([dream, dream]) == {}


def test_at_an_equal_budget_no_evaluated_mean_exceeds_it(runs):
    dream, reality = side(runs / "dream"), side(runs / "reality")
    for equal in at_equal_budget([dream, reality]):
        spent = {"steps in reality": lambda effort: effort.steps, "core-hours": lambda effort: effort.core_hours}
        ends = [spent[equal.what](each.evaluated_means[-1].point.effort) for each in (dream, reality)]
        assert equal.spent == min(ends)
        assert all(
            look is None or spent[equal.what](look.point.effort) <= equal.spent for look in equal.evaluated_means
        )
    assert at_equal_budget([dream, side(runs / "hidden")]) == []


def test_the_verb_prints_differences_of_scores_on_common_tracks(runs):
    confirm_by(runs / "dream", [1.0, 2.0, 3.0, 4.0])
    confirm_by(runs / "reality", [2.0, 3.5, 3.5, 5.5, 99.0])
    assert "+1.1 ± 0.2" in printed("compare", "dream", "reality")
    found = json.loads(printed("compare", "dream", "reality", "--json"))["differences"]
    assert [each["of"] for each in found] == ["at equal steps in reality", "at equal core-hours", "confirmed"]
    assert (found[-1]["seeds"], found[-1]["mean"], found[-1]["clear"]) == (4, 1.125, True)


def test_runs_without_scores_are_compared_by_their_settings(runs):
    rows = [cells(line) for line in printed("compare", "reality", "hidden").splitlines()]
    assert ["covariance", "diagonal", "full"] in rows
    assert call_here("compare", "reality")[0] == 2


def test_a_run_is_read_in_one_transaction_while_an_evaluation_closes(runs, monkeypatch):
    read = RunFolder.evaluations
    with closing(sqlite3.connect(runs / "dream" / "journal.sqlite", isolation_level=None)) as journal:
        journal.execute("PRAGMA journal_mode = wal")  # as a coordinator's
        query = "SELECT mean, generation FROM evaluation ORDER BY generation DESC LIMIT 1"
        mean, last = journal.execute(query).fetchone()
        journal.execute("UPDATE evaluation SET mean = NULL WHERE generation = ?", (last,))

        def and_then_one_more(run):
            found = read(run)
            journal.execute("UPDATE evaluation SET mean = ? WHERE generation = ?", (mean, last))
            return found

        monkeypatch.setattr(RunFolder, "evaluations", and_then_one_more)
        before, after = side(runs / "dream"), side(runs / "dream")
    assert len(after.evaluated_means) == len(before.evaluated_means) + 1


def test_what_a_fork_inherited_is_named(runs):
    inherited = '{"driven": 5000, "microseconds": 9000000}'
    change_journal(runs / "reality", "INSERT INTO run VALUES (?, ?)", START_EFFORT, inherited)
    fork = side(runs / "reality")
    assert re.search(r"\b5k .* 0\.0025 ", fork.spent)
    assert fork.total.steps > fork.inherited.steps == 5000
