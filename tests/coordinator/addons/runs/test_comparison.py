"""Runs beside each other: what differs, and what a difference is worth.
Tests common/addons/analysis/comparison.py and dreamfleet/experiments/verbs/compare.py."""

import json
import re
import sqlite3
from contextlib import closing

from dreamfleet.common.addons.analysis.comparison import ComparedRun, at_equal_budget, difference, differing_settings
from dreamfleet.common.cli import command_line
from dreamfleet.common.runs.effort import START_EFFORT
from dreamfleet.common.runs.paired_difference import PairedDifference
from dreamfleet.common.runs.records import StoredConfirmation
from dreamfleet.common.runs.run_folder import CONFIRMED, RunFolder, open_run
from dreamfleet.common.runs.seeds import CONFIRMING_OFFSET, VALIDATION
from tests.support.tables import cells


def confirm(runs, name, scores):
    """As a run ends: its last evaluated mean on fresh tracks."""
    with open_run(runs, name) as run:
        last, closed = run.evaluations()[-1].generation, len(run.history())
    with closing(sqlite3.connect(runs / name / "journal.sqlite")) as journal:
        for number, score in enumerate(scores):
            row = (
                f"{name}{number}".encode(),
                last,
                CONFIRMING_OFFSET + number,
                VALIDATION.start + CONFIRMING_OFFSET + number,
                score,
            )
            query = "INSERT INTO result VALUES (?, 'evaluate', ?, 0, ?, ?, ?, 10, 0.1, 'w', 'f', 1, 'c', NULL)"
            journal.execute(query, row)
        found = StoredConfirmation(last, len(scores), sum(scores) / len(scores), 1.0, closed)
        journal.execute("INSERT INTO run VALUES (?, ?)", (CONFIRMED, found.to_json()))
        journal.commit()


def sides(runs, *names):
    found = []
    for name in names:
        with open_run(runs, name) as run:
            found.append(ComparedRun.of(run))
    return found


def test_settings_that_differ_are_named_and_others_are_not(runs):
    found = differing_settings(sides(runs, "dream", "reality"))
    assert found["seed"] == [12, 11]
    assert found["task.task"] == ["dream", "car-racing"]
    assert "sigma0" not in found
    assert differing_settings(sides(runs, "dream", "dream")) == {}


def test_at_an_equal_budget_no_evaluated_mean_exceeds_it(runs):
    dream, reality = sides(runs, "dream", "reality")
    for equal in at_equal_budget([dream, reality]):
        spent = {"steps in reality": lambda effort: effort.steps, "core-hours": lambda effort: effort.core_hours}
        ends = [spent[equal.what](side.evaluated_means[-1].point.effort) for side in (dream, reality)]
        assert equal.spent == min(ends)
        assert all(
            look is None or spent[equal.what](look.point.effort) <= equal.spent for look in equal.evaluated_means
        )
    assert at_equal_budget(sides(runs, "dream", "hidden")) == []


def test_confirmed_scores_are_compared_on_common_tracks(runs):
    confirm(runs, "dream", [1.0, 2.0, 3.0, 4.0])
    confirm(runs, "reality", [2.0, 3.5, 3.5, 5.5, 99.0])
    one, other = sides(runs, "dream", "reality")
    found = difference(one.confirmed_scores, other.confirmed_scores)
    assert isinstance(found, PairedDifference)
    assert (found.seeds, found.mean, found.is_significant) == (4, 1.125, True)


def test_the_verb_prints_the_difference_as_text_and_as_json(runs, capsys):
    confirm(runs, "dream", [1.0, 2.0, 3.0, 4.0])
    confirm(runs, "reality", [2.0, 3.5, 3.5, 5.5])
    words = ["compare", "dream", "reality", "--runs-dir", str(runs)]
    assert command_line.main(words) == 0
    text = capsys.readouterr().out
    assert "+1.1 ± 0.2" in text
    assert command_line.main([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [each["of"] for each in report["differences"]] == [
        "at equal steps in reality",
        "at equal core-hours",
        "confirmed",
    ]


def test_runs_without_scores_are_compared_by_their_settings(runs, capsys):
    assert command_line.main(["compare", "reality", "hidden", "--runs-dir", str(runs)]) == 0
    text = capsys.readouterr().out
    assert ["covariance", "diagonal", "full"] in [cells(line) for line in text.splitlines()]
    assert command_line.main(["compare", "reality", "--runs-dir", str(runs)]) == 2


def test_a_run_is_read_in_one_transaction_while_an_evaluation_closes(runs, monkeypatch):
    read = RunFolder.evaluations
    with closing(sqlite3.connect(runs / "dream" / "journal.sqlite", isolation_level=None)) as journal:
        journal.execute("PRAGMA journal_mode = wal")  # as a coordinator's
        last = journal.execute("SELECT max(generation) FROM evaluation").fetchone()[0]
        mean = journal.execute("SELECT mean FROM evaluation WHERE generation = ?", (last,)).fetchone()[0]
        journal.execute("UPDATE evaluation SET mean = NULL WHERE generation = ?", (last,))

        def and_then_one_more(run):
            found = read(run)
            journal.execute("UPDATE evaluation SET mean = ? WHERE generation = ?", (mean, last))
            return found

        monkeypatch.setattr(RunFolder, "evaluations", and_then_one_more)
        (before,) = sides(runs, "dream")
        (after,) = sides(runs, "dream")
    assert len(after.evaluated_means) == len(before.evaluated_means) + 1


def test_what_a_fork_inherited_is_named(runs):
    with closing(sqlite3.connect(runs / "reality" / "journal.sqlite")) as journal:
        journal.execute("INSERT INTO run VALUES (?, ?)", (START_EFFORT, '{"driven": 5000, "microseconds": 9000000}'))
        journal.commit()
    _, fork = sides(runs, "dream", "reality")
    assert re.search(r"\b5k .* 0\.0025 ", fork.spent)
    assert fork.total.steps > fork.inherited.steps == 5000
