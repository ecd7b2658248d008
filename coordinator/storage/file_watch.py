"""Whether a live run's files are still its own: what was removed or replaced under it is rescued, and it leaves.

SQLite goes on writing into a file that has lost its name, and nobody would notice before the process is gone and the
file with it. So names are compared with what was opened, about once a second and before the run ends.
"""

import logging
import os
import shlex
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import gettempdir

from dreamfleet.common.errors import DreamfleetError, JournalError
from dreamfleet.common.host.logs import log_event
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.coordinator.storage.journal_file import sqlite_side_files
from dreamfleet.coordinator.storage.served_bundle import ServedBundle

log = logging.getLogger(__name__)
CHECK_INTERVAL = 1.0  # seconds between two looks; docs/reference/protocol.md
SETTLE = 0.3  # seconds after which the removal of a folder is complete
RESCUED = "rescued"  # docs/how-to/troubleshooting.md

Identity = tuple[int, int]


class FileWatch:
    """The files of one coordinator's incarnation: its folder, its journal and that one's log, its bundle. Close it."""

    def __init__(self, journal: Journal, bundle: ServedBundle | None, resume_command: Callable[[Path], str]) -> None:
        """`resume_command` gives the command that continues the run in a folder."""
        self._resume_command = resume_command
        self._journal = journal
        self._bundle = bundle
        self._folder = journal.path.parent
        self._folder_fd = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
        self._folder_identity = file_identity(self._folder)
        self._own_files: dict[str, Identity | None] = {JOURNAL: file_identity(journal.path)}
        self._next = float("-inf")
        self._leaving = False

    @property
    def command(self) -> str:
        """What continues the run once its coordinator has left, in whichever folder somebody is."""
        return self._resume_command(self._folder.absolute())

    def close(self) -> None:
        """Let go of the folder."""
        os.close(self._folder_fd)

    def check(self, now: float, *, at_once: bool = False) -> None:
        """Compare; `JournalError` says what was rescued, and how to go on."""
        if self._leaving or (now < self._next and not at_once):
            return
        self._next = now + CHECK_INTERVAL
        for path in sqlite_side_files(self._journal.path)[:2]:  # they come with the first write
            if self._own_files.get(path.name) is None:
                self._own_files[path.name] = file_identity(path)
        if (
            file_identity(self._folder) != self._folder_identity
            or not self._has_own_files(self._folder)
            or self._journal.is_overwritten
            or self._journal.is_log_cut
        ):
            self._rescue_and_leave()
        self._journal.check_incarnation()
        self._restore_bundle()

    def _has_own_files(self, folder: Path) -> bool:
        """Whether the names in a folder are those of the files that are open."""
        return all(own is None or file_identity(folder / name) == own for name, own in self._own_files.items())

    def _rescue_and_leave(self) -> None:
        self._leaving = True
        time.sleep(SETTLE)
        cut = self._journal.is_log_cut
        if not cut:
            self._journal.commit()
        folder = self._find_folder()
        if not cut and folder is not None and folder != self._folder and self._has_own_files(folder):
            raise JournalError(
                f"the run's folder was moved to {folder} while it was served: nothing is lost; continue with: "
                f"{self._resume_command(folder)}"
            )
        raise JournalError(self._rescue(folder))

    def _find_folder(self) -> Path | None:
        """Where the folder is now; `None` if it is gone."""
        with suppress(OSError):
            for path in (self._folder, Path(f"/proc/self/fd/{self._folder_fd}").readlink()):
                if file_identity(path) == self._folder_identity:
                    return path
        return None

    def _rescue(self, folder: Path | None) -> str:
        """Copy the data of the open connection to the first place that accepts it; returns the message for people."""
        rescues = [] if folder is None else [partial(self._rescue_into, folder)]
        rescues += [partial(self._rescue_beside, parent) for parent in (self._folder.parent, Path(gettempdir()))]
        failures = []
        for rescue in rescues:
            try:
                return rescue()
            except (OSError, DreamfleetError) as error:
                failures.append(str(error))
        return (
            f"{self._journal.path} or its write-ahead log was removed, replaced or truncated while it was served, and "
            f"what it held could not be rescued: {'; '.join(dict.fromkeys(failures))}"
        )

    def _rescue_into(self, folder: Path) -> str:
        """Into the run's own folder, under the journal's own name if that is free."""
        target = folder / JOURNAL
        copy = free_path(folder / f"journal-{RESCUED}.sqlite")
        self._journal.save_copy(copy)
        foreign = file_identity(target) not in (None, self._own_files[JOURNAL])
        for each in sqlite_side_files(target):  # a log without its journal would damage whatever has that one's name
            if each.exists() and file_identity(each) == self._own_files.get(each.name):
                each.unlink()
            elif each.exists() and not foreign:
                each.replace(free_path(each.with_name(f"{each.name}.other")))
        if foreign:
            left = [str(each) for each in sqlite_side_files(target) if each.exists()]
            clear = f"{shlex.join(('rm', *left))} && " if left else ""
            move = shlex.join(("mv", str(copy), str(target)))
            return (
                f"{target} was replaced while it was served: what is there now is left as it is, and what the run "
                f"wrote is in {copy}. Continue with: {clear}{move} && {self._resume_command(folder)}"
            )
        copy.replace(target)
        return (
            f"{target} or its write-ahead log was removed, overwritten or truncated while it was served: rescued to "
            f"the last result as {target}; continue with: {self._resume_command(folder)}"
        )

    def _rescue_beside(self, parent: Path) -> str:
        """Into a folder of its own, as another run: its own is gone."""
        folder = free_path(parent / f"{self._folder.name[:50]}-{RESCUED}")
        folder.mkdir(mode=0o700, parents=True)
        try:
            self._journal.save_copy(folder / JOURNAL)
        except BaseException:
            folder.rmdir()
            raise
        if self._bundle is not None:
            self._bundle.restore_into(folder)
        return (
            f"{self._folder} was removed while it was served: rescued to the last result as {folder / JOURNAL}; "
            f"continue with: {self._resume_command(folder)}"
        )

    def _restore_bundle(self) -> None:
        """A run without its world model could not be continued."""
        try:
            if self._bundle is not None and self._bundle.restore_into(self._folder):
                text = "the run's copy of its world model was removed while it was served: written again"
                log_event(log, "bundle written", text, level=logging.WARNING)
        except OSError as error:
            log.warning("the run's copy of its world model was removed, and cannot be written: %s", error.strerror)


def file_identity(path: Path) -> Identity | None:
    """Which file or folder a name stands for; `None`: there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def free_path(path: Path) -> Path:
    """A name like this one that nothing has."""
    number, found = 1, path
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return found
