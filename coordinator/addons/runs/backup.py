"""A second copy of a run's folder, whole and durable, also while a coordinator serves the run.

SQLite copies the journal as it is at one moment; everything else in the folder is frozen, or follows from the journal.
The copy is a run like any other.
"""

import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path

from dreamfleet.common.addons.evaluation_report import REPORT
from dreamfleet.common.errors import ControllerError, JournalError, UsageError
from dreamfleet.common.files.atomic_write import fsync_path
from dreamfleet.common.files.locks import open_lock, try_lock
from dreamfleet.common.printable import one_line, plural
from dreamfleet.common.runs.lookup import load_controller_of
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_lock import run_lock
from dreamfleet.common.runs.run_paths import BUNDLE, CONTROLLER, JOURNAL, ROLLOUTS, run_command
from dreamfleet.coordinator.storage.journal_file import copy_database, sqlite_side_files

# What an earlier copy has and a new one lacks. A run only ever adds events, of which it forgets the oldest, results,
# which a recall sets aside, and batches. An event has its time: copies that were both continued share no later one.
_EVENT = "SELECT number, happened, incarnation, text, what, worker FROM"
_KEY = "kind, generation, candidate, episode, digest"  # by which nearly all are found; one may count elsewhere now
LOST = (
    f"SELECT * FROM ({_EVENT} earlier.event ORDER BY number DESC LIMIT 1) "  # noqa: S608
    f"WHERE number >= (SELECT coalesce(min(number), 0) FROM main.event) EXCEPT {_EVENT} main.event",
    f"WITH own AS (SELECT {_KEY} FROM earlier.result UNION ALL SELECT {_KEY} FROM earlier.recalled) "  # noqa: S608
    f"SELECT digest FROM own WHERE ({_KEY}) NOT IN (SELECT {_KEY} FROM main.result) "
    "AND digest NOT IN (SELECT digest FROM main.recalled) EXCEPT SELECT digest FROM main.result",
    "SELECT id FROM earlier.batch EXCEPT SELECT id FROM main.batch",
)


def back_up(source: RunFolder, target: Path) -> None:
    """Copy the run into the folder `target`, of its own name; an earlier copy of the same run there is replaced.

    Whatever ends this, one whole copy is left if there was one. `UsageError` for a target that is something else, a
    copy that holds what the run does not, a run that is served from there, or the run itself; `JournalError` where
    the disk refuses.
    """
    with _journal_errors(target):
        _check_target(source, target)
    aside, former = (target.with_name(f".{target.name}.{word}") for word in ("part", "former"))
    with _journal_errors(target), _backup_lock(target):
        _clear(target, aside, former)  # an earlier call may have been killed
        try:
            aside.mkdir(mode=0o700)
            _copy_run(source, target, aside)
            # Nobody goes on from the earlier copy while it is compared and replaced.
            with run_lock(target) if target.exists() else nullcontext():
                if target.exists():
                    _check_nothing_is_lost(source, target, aside)
                    target.rename(former)
                aside.rename(target)
            fsync_path(target.parent)
        finally:
            _clear(target, aside, former)


@contextmanager
def _backup_lock(target: Path) -> Iterator[None]:
    """Inside, nobody else backs up into this folder: what the one has half copied the other would take for its own."""
    target.parent.mkdir(parents=True, exist_ok=True)
    path = target.with_name(f".{target.name}.lock")
    while True:
        with open_lock(path) as lock:
            if not try_lock(lock):
                raise UsageError(f"another backup into {target} is running: wait for it")
            if not path.exists() or not os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                continue  # who held it has removed it
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _clear(target: Path, aside: Path, former: Path) -> None:
    """Leave one copy under its name: the new one if it has come to be, else the earlier one."""
    if former.exists() and not target.exists():
        former.rename(target)
    for left in (aside, former):
        shutil.rmtree(left, ignore_errors=True)


def _check_target(source: RunFolder, target: Path) -> None:
    if target.is_symlink():
        raise UsageError(f"{target} is a link: name the folder of runs that it leads to with --to")
    if (target.exists() and target.samefile(source.path)) or target.resolve().is_relative_to(source.path.resolve()):
        raise UsageError(f"{target} is the run itself, or inside it: name another folder with --to")
    if not (target / JOURNAL).exists():
        if target.exists():
            raise UsageError(f"{target} exists and is not a run: name another folder with --to")
        return
    with open_run(target.parent, target.name) as other:
        if other.uid != source.uid:
            raise UsageError(f"{target} is another run of this name: name another folder with --to")


def _check_nothing_is_lost(source: RunFolder, target: Path, new: Path) -> None:
    """`UsageError` if the earlier copy in `target` holds what the new one does not.

    It was continued or changed there, as each incarnation and each bar writes an event first. Or the run lost its last
    results, such as with a damaged write-ahead log.
    """
    with RunFolder(target) as earlier, RunFolder(new) as copied:  # they are journals of ours
        try:
            is_lost = _is_lost(target / JOURNAL, new / JOURNAL)
        except sqlite3.Error as error:
            why = f"it cannot be compared: {one_line(str(error))}"
            raise JournalError(f"{target} is kept, for {why}; {_other_ways(target)}") from error
        if is_lost:
            raise UsageError(
                f"{target} is kept, for it holds what {source.path} does not: it is at {_describe(earlier)}, and "
                f"{source.path} at {_describe(copied)}; {_other_ways(target)}"
            )


def _is_lost(earlier: Path, new: Path) -> bool:
    """Whether the earlier journal holds what the new one does not."""
    with closing(sqlite3.connect(_read_only(new), uri=True)) as database:
        database.execute("ATTACH ? AS earlier", (_read_only(earlier),))
        return any(database.execute(query).fetchone() for query in LOST)


def _read_only(path: Path) -> str:
    return f"{path.absolute().as_uri()}?mode=ro"


def _describe(run: RunFolder) -> str:
    generations, results = len(run.history()), run.result_count()
    counts = f"{plural(generations, 'closed generation')}, {plural(results, 'result')}"
    return f"incarnation {run.fact('incarnation') or 0} with {counts}"


def _other_ways(target: Path) -> str:
    return f"name another folder with --to, or remove it: `{run_command(target, 'runs', 'delete')}`"


def _copy_run(source: RunFolder, earlier: Path, folder: Path) -> None:
    """Copy all that the run is made of.

    What the journal names lies in the folder before the journal does, so that it is copied behind it. An evaluation
    that only the `earlier` copy has is kept.
    """
    _copy_controller_and_journal(source, folder)
    if source.spec.bundle:
        shutil.copy2(source.bundle_path, folder / BUNDLE)
    with RunFolder(folder) as copy:
        copy.verify()
        with suppress(ControllerError):  # it has none yet, or another run's, which nobody takes for its own
            load_controller_of(copy).save(copy.controller_path)
        drives = copy.rollouts()
    if drives:
        (folder / ROLLOUTS).mkdir()
    for drive in drives:
        shutil.copy2(source.path / ROLLOUTS / drive.name, folder / ROLLOUTS / drive.name)
    if report := next((path for path in (source.path / REPORT, earlier / REPORT) if path.is_file()), None):
        shutil.copy2(report, folder / REPORT)
    for path in (*folder.rglob("*"), folder):
        fsync_path(path)


def _copy_controller_and_journal(source: RunFolder, folder: Path) -> None:
    """The controller first: where it lags behind the journal, the copy's follows it; it must not be ahead.

    A recall in between takes back what the controller follows from: then both are copied again.
    """
    while True:
        before = _recalls(source)
        (folder / CONTROLLER).unlink(missing_ok=True)
        with suppress(FileNotFoundError):  # there is none before the first closed generation
            shutil.copy2(source.controller_path, folder / CONTROLLER)
        _copy_journal(source, folder / JOURNAL)
        with RunFolder(folder) as copy:
            if _recalls(copy) == before:
                return
        for left in (folder / JOURNAL, *sqlite_side_files(folder / JOURNAL)):
            left.unlink(missing_ok=True)


def _recalls(run: RunFolder) -> tuple[object, ...]:
    """What differs once results were recalled: each recall bars hosts, and ends an incarnation of the coordinator."""
    checks = run.checks
    return run.fact("incarnation"), checks and (checks.barred, checks.recalled)


def _copy_journal(source: RunFolder, path: Path) -> None:
    try:
        with closing(sqlite3.connect(_read_only(source.path / JOURNAL), uri=True)) as live:
            found, _ = copy_database(live, path)
    except sqlite3.Error as error:
        raise JournalError(f"the journal of run {source.name} cannot be copied to {path.parent}: {error}") from error
    if found != "ok":
        raise JournalError(f"the journal of run {source.name} is damaged: {found}; the earlier copy is kept")


@contextmanager
def _journal_errors(target: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        why = error.strerror or error
        raise JournalError(f"cannot back up into {target}: {why}; an earlier copy, if there is one, is kept") from error
