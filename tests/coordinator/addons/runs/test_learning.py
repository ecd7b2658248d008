"""What runs learnt from what they spent, as data and as a picture.
Tests common/runs/effort.py and common/addons/analysis/learning.py."""

import html
import sqlite3
from contextlib import closing
from dataclasses import replace

import pytest

from dreamfleet.common.addons.analysis.learning import LearningCurve, Point
from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs.effort import START_EFFORT, Effort
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.worlds.shipped import WORLDS
from dreamfleet.coordinator.addons.runs.plot import learning_figure, save_figure

FIRST, LAST = Effort(10**5, 10**4, 0, 10**9), Effort(2 * 10**5, 9 * 10**4, 0, 3 * 10**9)
PAPERS_NAME = WORLDS["car-racing"].published.source
LOOK = Point(FIRST, 310.0, 80.0)
CURVE = LearningCurve("night", "car-racing", (LOOK,), Point(LAST, 680.0, 20.0), LOOK, LAST)


def sums(runs, name, until):
    with closing(sqlite3.connect(runs / name / "journal.sqlite")) as journal:
        return dict(journal.execute("SELECT kind, sum(steps) FROM result WHERE generation <= ? GROUP BY 1", (until,)))


def curve_of(runs, name):
    with open_run(runs, name) as run:
        return LearningCurve.of(run)


@pytest.mark.parametrize(("name", "kind"), [("reality", "driven"), ("dream", "dreamt")])
def test_each_evaluation_stands_over_all_that_was_spent_up_to_it(runs, name, kind):
    curve = curve_of(runs, name)
    with open_run(runs, name) as run:
        generations = [each.generation for each in run.evaluations()]
        assert [each.score for each in curve.points] == [each.mean for each in run.evaluations()]
    for generation, point in zip(generations, curve.points, strict=True):
        steps = sums(runs, name, generation)
        assert (getattr(point.effort, kind), point.effort.judged) == (steps["score"], steps["evaluate"])
        assert point.effort.steps == steps["evaluate"] + (steps["score"] if kind == "driven" else 0)
        assert 0 < point.effort.microseconds <= curve.total.microseconds
    assert (curve.world, curve.confirmed) == ("car-racing", None)


def test_what_was_spent_on_its_start_counts_for_a_run(runs):
    before = curve_of(runs, "reality")
    with closing(sqlite3.connect(runs / "reality" / "journal.sqlite")) as journal, journal:
        journal.execute("INSERT INTO run VALUES (?, ?)", (START_EFFORT, '{"driven": 1000, "dreamt": 7}'))
    after = curve_of(runs, "reality")
    assert after.points[0].effort == before.points[0].effort + Effort(1000, 0, 7)
    assert after.total == before.total + Effort(1000, 0, 7)


def test_a_run_without_evaluations_has_no_curve(runs):
    with pytest.raises(UsageError, match=r"hidden .*--evaluate-every"):
        curve_of(runs, "hidden")


@pytest.mark.parametrize(
    ("words", "made"),
    [(("hidden",), "hidden-fitness.png"), (("reality",), "reality-fitness.png"),
     (("reality", "--kind", "learning"), "reality-learning.png"), (("reality", "dream"), "reality-dream-learning.png")],
)  # fmt: skip
def test_the_kind_and_the_file_follow_from_the_runs_or_what_is_named(runs, tmp_path, monkeypatch, capsys, words, made):
    monkeypatch.chdir(tmp_path)
    assert command_line.main(["runs", "plot", *words, "--runs-dir", str(runs)]) == 0
    assert capsys.readouterr().out == f"{made}\n"
    assert (tmp_path / made).read_bytes().startswith(b"\x89PNG")


def test_runs_of_several_worlds_are_drawn_with_a_note_and_short_ones_without_marks(runs, tmp_path, capsys):
    out = tmp_path / "a.svg"
    words = ["runs", "plot", "reality", "dream", "--runs-dir", str(runs), "--out", str(out)]
    assert command_line.main(words) == 0
    assert PAPERS_NAME not in html.unescape(out.read_text())
    with closing(sqlite3.connect(runs / "reality" / "journal.sqlite")) as journal, journal:
        journal.execute("UPDATE run SET value = replace(value, 'car-racing', 'gym:Other-v0')")
    assert command_line.main(words) == 0
    assert "car-racing, gym:Other-v0" in capsys.readouterr().err
    assert "reality in gym:Other-v0: " in html.unescape(out.read_text())


def test_a_picture_names_runs_axes_and_published_marks_and_equal_ones_are_equal_files(tmp_path):
    paths = [tmp_path / "a.svg", tmp_path / "b.svg"]
    for path in paths:
        save_figure(learning_figure([CURVE], WORLDS["car-racing"].published), path)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    text = html.unescape(paths[0].read_text())  # letters are shapes, and what they spell stands beside them
    for said in ("night: 290k", "core-hours", PAPERS_NAME, "823"):
        assert said in text, said


def test_a_published_score_whose_steps_are_unknown_is_a_line_across_both_pictures(tmp_path):
    save_figure(learning_figure([CURVE], WORLDS["takecover"].published), tmp_path / "a.svg")
    text = html.unescape((tmp_path / "a.svg").read_text())
    assert WORLDS["takecover"].published.source in text
    assert "night: 290k" in text


def test_the_verb_makes_the_folder_that_it_draws_in(runs, tmp_path, capsys):
    out = tmp_path / "pictures" / "curve.png"
    assert command_line.main(["runs", "plot", "reality", "--runs-dir", str(runs), "--out", str(out)]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    assert out.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("reality", "--out", "a.gif"), ".png"),
        (("reality", "dream", "--kind", "fitness"), "fitness"),
        (("nowhere",), "'nowhere'"),
        (("reality", "hidden"), "hidden"),
    ],
)
def test_what_cannot_be_drawn_says_why(runs, capsys, monkeypatch, tmp_path, words, says):
    monkeypatch.chdir(tmp_path)
    assert command_line.main(["runs", "plot", *words, "--runs-dir", str(runs)]) != 0
    assert says in capsys.readouterr().err


def test_an_axis_is_logarithmic_only_over_a_decade_and_says_so(tmp_path):
    for factor, says in ((20, True), (3, False)):
        points = [Point(Effort(driven=times * 1000, microseconds=10**6), 500.0, 9.0) for times in (1, factor)]
        curve = replace(CURVE, points=tuple(points), confirmed=None, reported=None)
        save_figure(learning_figure([curve], None), tmp_path / "a.svg")
        text = html.unescape((tmp_path / "a.svg").read_text())
        assert ("(log scale)" in text) == says
