"""Journals of recorded runs, changed behind the product's back."""

import sqlite3
from contextlib import closing
from pathlib import Path

from dreamfleet.common.runs.records import StoredConfirmation
from dreamfleet.common.runs.run_folder import CONFIRMED, RunFolder
from dreamfleet.common.runs.run_paths import JOURNAL

RUNS = Path(__file__).parents[1] / "fixtures" / "runs"


def change_journal(run, statement, *values):
    """Run one SQL statement on the journal in the folder `run`; the rows that it returns."""
    with closing(sqlite3.connect(run / JOURNAL)) as journal, journal:
        return journal.execute(statement, values).fetchall()


def change_settings(run, change):
    """Store what `change` makes of a run's settings; the text that was stored."""
    with RunFolder(run) as stored:
        text = change(stored.settings).to_json()
    change_journal(run, "UPDATE run SET value = ? WHERE key = 'settings'", text)
    return text


def confirm(run, *figures):
    """Store a confirmation of these figures in the folder `run`."""
    change_journal(run, "INSERT INTO run VALUES (?, ?)", CONFIRMED, StoredConfirmation(*figures).to_json())
