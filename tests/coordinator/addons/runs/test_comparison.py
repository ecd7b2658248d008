"""Runs beside each other: what differs, and what a difference is worth.
Tests common/addons/analysis/comparison.py and dreamfleet/experiments/verbs/compare.py."""

import json
import re
import sqlite3
from contextlib import closing

from dreamfleet.common.addons.analysis.comparison import ComparedRun, at_equal_budget, differing_settings
from dreamfleet.common.runs.effort import START_EFFORT
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.seeds import CONFIRMING_OFFSET, VALIDATION
from tests.support.journals import change_journal, confirm
from tests.support.processes import call_here, printed
from tests.support.tables import cells

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
