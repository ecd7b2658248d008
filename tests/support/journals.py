"""Journals of recorded runs, changed behind the product's back."""

import sqlite3
from contextlib import closing

from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import JOURNAL


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
