"""The commands of a coordinator that leaves, which people paste: each path in them is one word."""

import subprocess

import pytest

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import JournalError
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.storage import file_watch
from dreamfleet.coordinator.storage.journal import Journal
from tests.support.samples import SPEC

SETTINGS = RunSettings(SPEC, ControllerShape(1, 3), 2, 1, 0.1, "diagonal", 1, 5, 2)


def test_the_command_that_puts_a_rescued_journal_back_touches_no_other_file(tmp_path, random_bundle, monkeypatch):
    monkeypatch.setattr(file_watch, "SETTLE", 0)
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "my runs" / "night"
    others = [tmp_path / "my", tmp_path / "runs" / "night" / "journal.sqlite-wal"]
    folder.mkdir(parents=True)
    others[1].parent.mkdir(parents=True)
    Journal.create(folder, SETTINGS, random_bundle.path).close()
    journal = Journal(folder / "journal.sqlite")
    watch = file_watch.FileWatch(journal, None, lambda _: "true")
    watch.check(0.0)
    journal.path.rename(folder / "away")
    log = folder / "journal.sqlite-wal"
    log.unlink(missing_ok=True)
    for path in (journal.path, log, *others):
        path.write_text("another program's")
    with pytest.raises(JournalError) as left:
        watch.check(1e9)
    watch.close()
    journal.close()
    subprocess.run(["sh", "-ec", str(left.value).partition("Continue with: ")[2]], check=True)
    assert not log.exists()
    assert [each.read_text() for each in others] == ["another program's"] * 2
    with RunFolder(folder) as run:
        assert run.settings == SETTINGS
