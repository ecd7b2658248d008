"""Runs on disk: one folder a run, its journal read-only, and the list of them. Only the coordinator writes."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from datetime import datetime
from difflib import SequenceMatcher
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.common.files.regular_files import check_regular, is_folder, path_exists
from dreamfleet.common.printable import join_some, one_line
from dreamfleet.common.protocol.host_classes import HostClasses, class_from_fingerprint, count
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.result_bounds import clamp_count, to_finite
from dreamfleet.common.runs import schema
from dreamfleet.common.runs.effort import Effort, GenerationEffort
from dreamfleet.common.runs.records import (
    RunSettings,
    StoredCandidate,
    StoredConfirmation,
    StoredEvaluation,
    StoredGeneration,
    StoredResult,
    best_evaluation,
)
from dreamfleet.common.runs.seeds import CHOOSING_OFFSET, CONFIRMING_OFFSET, VALIDATION
from dreamfleet.common.runs.stages import BegunStage, begun_stages

JOURNAL = "journal.sqlite"
BUNDLE = "bundle.zip"
CONTROLLER = "controller.npz"
LOCK_RETRY_PAUSES = (
    0.01,
    0.05,
)  # seconds until a lock is tried again: whoever asks whether a run is live has it for an instant
ARCHIVE = "archive"
MAX_LISTED_RUNS = 8  # runs by name, where one is not there
ROLLOUTS = "rollouts"
CONFIRMED = "confirmed"  # the fact's name
ENDED_AT = "ended_at"  # the fact's name: when the run ended
ENDING = "ending"  # the fact's name: the limit that was reached, while the last evaluations are waited for and after


class RunFolder:
    """A run's folder, read-only; close it, or use it in a `with`.

    >>> from dreamfleet import open_run
    >>> with open_run("cartpole") as run:
    ...     generation = run.history()[0]
    ...     print(run.spec.task, generation.number, generation.worst <= generation.mean <= generation.best)
    gym:CartPole-v1 0 True
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = path.name
        self._connection, version = _connect_read_only(path / JOURNAL)
        self._class_column = "host_class" if version >= schema.HOST_CLASS_VERSION else "''"

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the journal."""
        self._connection.close()

    @contextmanager
    def read_transaction(self) -> Iterator[None]:
        """All that is read within is of one moment, whatever a coordinator writes meanwhile."""
        if self._connection.in_transaction:
            yield
            return
        self._query("BEGIN")  # the moment is that of the first reading
        try:
            yield
        finally:
            with suppress(sqlite3.Error):
                self._connection.rollback()

    @property
    def settings(self) -> RunSettings:
        """What is frozen with the run."""
        return RunSettings.from_json(self._fact("settings") or "")

    @property
    def spec(self) -> TaskSpec:
        """What is scored in."""
        return self.settings.task

    @property
    def state(self) -> str:
        """In words: why it ended; else live, while a coordinator of this host holds it, or open, to be continued."""
        ended = self.ended
        return f"ended: {ended}" if ended else "live" if _has_live_holder(self.path) else "open"

    @property
    def uid(self) -> str:
        """The random identity of the run."""
        return self._fact("uid") or ""

    @property
    def created(self) -> str:
        """When the run began, ISO 8601, UTC."""
        return self._fact("created") or ""

    @property
    def fingerprint(self) -> str | None:
        """The fingerprint that the run admits: its first accepted result's."""
        return self._fact("fingerprint")

    @property
    def ended(self) -> str | None:
        """Why the run ended, or `None` if it did not."""
        return self._fact("ended")

    @property
    def ended_at(self) -> str | None:
        """When it ended, ISO 8601, UTC; `None` if it did not, or did before this was written."""
        return self._fact(ENDED_AT) if self.ended else None

    @property
    def duration_seconds(self) -> float | None:
        """Seconds from its beginning to its end, its pauses among them; `None` as for `ended_at`."""
        if (ended_at := self.ended_at) is None:
            return None
        return (datetime.fromisoformat(ended_at) - datetime.fromisoformat(self.created)).total_seconds()

    @property
    def classes(self) -> HostClasses:
        """What its accepted results are of."""
        return HostClasses.of(count(self._check_types(self._query(class_counts_query(self._class_column)), "ssi")))

    @property
    def bundle_path(self) -> Path:
        """The run's own copy of its world model."""
        return self.path / BUNDLE

    @property
    def controller_path(self) -> Path:
        """The reported controller; there from the first closed generation on."""
        return self.path / CONTROLLER

    def candidate(self, generation: int, number: int) -> NDArray[np.float32]:
        """A candidate's parameters `(size,)` as they travelled."""
        row = self._query_one("SELECT vector FROM candidate WHERE generation = ? AND number = ?", generation, number)
        if row is None:
            raise JournalError(f"run {self.name} has no candidate {generation}/{number}")
        return self._vector(row[0], "a candidate")

    def evaluated_mean(self, generation: int) -> NDArray[np.float32]:
        """The mean `(size,)` after a generation that was evaluated, as it travelled."""
        row = self._query_one("SELECT vector FROM evaluation WHERE generation = ?", generation)
        if row is None:
            raise JournalError(f"run {self.name} has no evaluation of generation {generation}")
        return self._vector(row[0], "an evaluated mean")

    def fitness(self, generation: int, number: int) -> float | None:
        """What the strategy was told of a candidate; `None` while its generation is open."""
        row = self._query_one("SELECT fitness FROM candidate WHERE generation = ? AND number = ?", generation, number)
        return None if row is None else self._check_types([row], "F")[0][0]

    def results(self, generation: int, number: int, kind: str = "score") -> list[StoredResult]:
        """A candidate's accepted results, by episode."""
        query = (
            f"SELECT {_RESULT}, {self._class_column} FROM result "  # noqa: S608
            "WHERE kind = ? AND generation = ? AND candidate = ? ORDER BY episode"
        )
        rows = self._check_types(self._query(query, kind, generation, number), "siiiififsss")
        return [StoredResult(*(*row[:-1], row[-1] or class_from_fingerprint(row[-2]))) for row in rows]

    def candidates(self) -> list[StoredCandidate]:
        """Every candidate by generation and number."""
        return [
            StoredCandidate(
                generation, number, fitness, episodes, clamp_count(int(to_finite(steps))), to_finite(seconds)
            )
            for generation, number, fitness, episodes, steps, seconds in self._check_types(
                self._query(_CANDIDATES), "iiFiff"
            )
        ]

    def scores(self, generation: int, *, confirming: bool = False) -> dict[int, float]:
        """What a generation's mean scored on each validation seed of its evaluation, or of its confirmation."""
        since, until = (CONFIRMING_OFFSET, VALIDATION.stop) if confirming else (0, CHOOSING_OFFSET)
        query = (
            "SELECT seed, fitness FROM result WHERE kind = 'evaluate' AND generation = ? AND episode BETWEEN ? AND ?"
        )
        return dict(self._check_types(self._query(query, generation, since, until - 1), "if"))

    def result_count(self) -> int:
        """Accepted results of every kind."""
        return int(self._query_one("SELECT count(*) FROM result")[0])

    def history(self) -> list[StoredGeneration]:
        """Every closed generation, oldest first."""
        query = "SELECT number, mean, std, best, worst, sigma, steps, seconds FROM generation WHERE closed IS NOT NULL"
        return [
            _stored_generation(*row) for row in self._check_types(self._query(query + " ORDER BY number"), "iFFFFfiF")
        ]

    def quartiles(self, generations: Iterable[int]) -> dict[int, tuple[float, float]]:
        """The lower and upper quartile of the candidates' fitness in each of these generations that is closed."""
        query = "SELECT fitness FROM candidate WHERE generation = ? AND fitness IS NOT NULL"
        found = {}
        for number in generations:
            rows = self._check_types(self._query(query, number), "f")
            if rows:
                low, high = np.percentile([to_finite(fitness) for (fitness,) in rows], (25, 75))
                found[number] = float(low), float(high)
        return found

    def evaluations(self) -> list[StoredEvaluation]:
        """Every finished evaluation of a mean, oldest first."""
        query = "SELECT generation, episodes, mean, std FROM evaluation WHERE mean IS NOT NULL ORDER BY generation"
        rows = self._check_types(self._query(query), "iiFF")
        if any(episodes < 1 for _, episodes, _, _ in rows):
            raise self._damage_error("an evaluation is of no episodes")
        return [StoredEvaluation(generation, episodes, to_finite(mean), to_finite(std))
                for generation, episodes, mean, std in rows]  # fmt: skip

    def confirmation(self) -> StoredConfirmation | None:
        """The confirmed score of what is reported; `None` where what is reported is not confirmed."""
        text, evaluations = self._fact(CONFIRMED), self.evaluations()
        if text is None:
            return None
        found = StoredConfirmation.from_json(text)
        return found if found.covers(best_evaluation(evaluations)) else None

    def efforts(self) -> list[GenerationEffort]:
        """What accepted results took, by generation; the drives that chose and confirmed the report stand apart."""
        settings = self.settings
        begun = begun_stages(settings, self.history(), self.evaluations())
        rows = self._check_types(self._query(efforts_query(begun)), "siiiff")
        return [GenerationEffort(generation, bool(confirming), Effort.of(settings.task.task, kind, *made,
                                                                         driven=bool(driven)))
                for kind, generation, confirming, driven, *made in rows]  # fmt: skip

    def rollouts(self) -> list[Path]:
        """Every collected drive that was accepted, oldest first."""
        query = "SELECT generation, episode FROM result WHERE kind = 'collect' ORDER BY generation, episode"
        return [rollout_path(self.path, *row) for row in self._check_types(self._query(query), "ii")]

    def strategy_state(self) -> bytes | None:
        """The strategy as it was before its latest generation was asked; `None` before the first."""
        row = self._query_one("SELECT state FROM strategy ORDER BY generation DESC LIMIT 1")
        return None if row is None else bytes(self._check_types([row], "b")[0][0])

    def fact(self, key: str) -> str | None:
        """One of the run's facts, such as the limits that it was last served with; `None` if it has no such fact."""
        return self._fact(key)

    def _vector(self, data: Any, what: str) -> NDArray[np.float32]:
        if not isinstance(data, bytes) or len(data) % 4:
            raise self._damage_error(f"{what} is no vector")
        return np.frombuffer(data, dtype="<f4").astype(np.float32)

    def _fact(self, key: str) -> str | None:
        row = self._query_one("SELECT value FROM run WHERE key = ?", key)
        return None if row is None else str(row[0])

    def _query_one(self, query: str, *values: Any) -> Any:
        rows = self._query(query, *values)
        return rows[0] if rows else None

    def _query(self, query: str, *values: Any) -> list[Any]:
        try:
            return self._connection.execute(query, values).fetchall()
        except (sqlite3.Error, OverflowError, UnicodeError) as error:
            if _is_locked(error):
                raise JournalError(
                    f"the journal of run {self.name} cannot be read: {_describe_with_remedy(error)}"
                ) from error
            raise self._damage_error(one_line(str(error))) from error

    def _check_types(self, rows: list[Any], kinds: str) -> list[Any]:
        """The rows, whose values are of these kinds: a damaged page, or another program, leaves others."""
        types = [_TYPES[each] for each in kinds]
        for row in rows:
            if not all(map(isinstance, row, types)):
                raise self._damage_error("a row holds values of another type")
        return rows

    def _damage_error(self, what: str) -> JournalError:
        return JournalError(f"the journal of run {self.name} is damaged: {what}; restore it from a copy")


def _stored_generation(
    first: int, mean: float, std: float, best: float, worst: float, sigma: float, steps: int, seconds: float
) -> StoredGeneration:
    """A row of the journal; older ones hold numbers that cannot be told."""
    told = to_finite(mean), to_finite(std), to_finite(best), to_finite(worst), to_finite(sigma)
    return StoredGeneration(first, *told, clamp_count(steps), to_finite(seconds))


_TYPES: dict[str, tuple[type, ...]] = {
    "i": (int,), "f": (int, float), "F": (int, float, NoneType), "s": (str,), "b": (bytes,),
}  # fmt: skip
_RESULT = "kind, generation, candidate, episode, seed, fitness, steps, seconds, worker, fingerprint"
_CANDIDATES = (
    "SELECT candidate.generation, number, candidate.fitness, count(digest), total(steps), total(seconds) "
    "FROM candidate LEFT JOIN result ON kind = 'score' AND candidate = number "
    "AND result.generation = candidate.generation GROUP BY 1, 2 ORDER BY 1, 2"
)


def class_counts_query(class_column: str = "host_class") -> str:
    """How many results there are of each class, which may be empty, and fingerprint."""
    return f"SELECT {class_column}, fingerprint, count(*) FROM result GROUP BY 1, 2"  # noqa: S608


def efforts_query(begun: Sequence[BegunStage]) -> str:
    """What results took: kind, generation, whether they confirmed, whether they were driven, steps, microseconds.

    Sums are floats, since old journals hold huge ones.
    """
    whens = " ".join(f"WHEN generation >= {each.since} THEN {each.stage.driven_episodes}" for each in reversed(begun))
    return (
        f"SELECT kind, generation, kind = 'evaluate' AND episode >= {CHOOSING_OFFSET}, "  # noqa: S608
        f"kind = 'score' AND episode < CASE {whens} ELSE 0 END, total(steps), "
        "total(CAST(seconds * 1e6 AS INTEGER)) FROM result GROUP BY 1, 2, 3, 4 ORDER BY 2, 3, 1, 4"
    )


def rollout_path(folder: Path, generation: int, episode: int) -> Path:
    """Where a rollout that a run collected lies: an episode as data sets hold it."""
    return folder / ROLLOUTS / f"{generation:06d}-{episode:04d}.npz"


def default_runs_dir() -> Path:
    """Where runs live unless told otherwise: `$DREAMFLEET_RUNS_DIR`, else `runs` here."""
    return Path(os.environ.get("DREAMFLEET_RUNS_DIR", "runs"))


def open_run(runs_dir: Path, name: str) -> RunFolder:
    """A run by name; `JournalError` names those that exist."""
    path = runs_dir / check_run_name(name)
    if not path_exists(path / JOURNAL):
        names = [each.name for each in run_paths(runs_dir)]
        names.sort(key=lambda each: -SequenceMatcher(None, name, each).quick_ratio())  # the likeliest first
        raise JournalError(
            f"no run {name!r} in {runs_dir}; there are: {join_some(names, MAX_LISTED_RUNS) or 'none yet'}"
        )
    return RunFolder(path)


def check_movable(folder: Path) -> None:
    """`JournalError` for a run's folder that holds other runs, or is a link: neither is moved or deleted."""
    if folder.is_symlink():
        raise JournalError(f"{folder} is a link: move or delete what it leads to by hand")
    if inside := ", ".join(each.name for each in run_paths(folder)):
        raise JournalError(f"{folder} holds other runs ({inside}): move them away first")


@contextmanager
def reporting_folder_errors(folder: Path) -> Iterator[None]:
    """What the system refuses to do with a run's folder, as one line."""
    try:
        yield
    except OSError as error:
        raise JournalError(f"{folder} cannot be moved or deleted: {error.strerror or error}") from error


def run_paths(runs_dir: Path) -> Iterator[Path]:
    """The folders of all runs, by name."""
    if not is_folder(runs_dir):
        return
    for journal in sorted(runs_dir.glob(f"*/{JOURNAL}")):
        yield journal.parent


def _connect_read_only(path: Path, *, rolled_back: bool = False) -> tuple[sqlite3.Connection, int]:
    """An open journal and its schema version."""
    # A finished journal on a read-only disk has no shared-memory file to map; nobody writes it either.
    immutable = "" if os.access(path.parent, os.W_OK) else "&immutable=1"
    try:
        check_regular(path)  # SQLite would wait for what a pipe says
        connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro{immutable}", uri=True)
    except (sqlite3.Error, OSError) as error:
        raise JournalError(f"{path} cannot be read: {error}") from error
    try:
        return connection, schema.check_schema(connection, path)
    except (sqlite3.Error, UnicodeError) as error:
        connection.close()
        if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_READONLY_ROLLBACK and not rolled_back:
            _roll_back(path)
            return _connect_read_only(path, rolled_back=True)
        raise JournalError(f"{path} cannot be read: {_describe_with_remedy(error)}") from error
    except JournalError:
        connection.close()
        raise


def _roll_back(path: Path) -> None:
    """Undo what a coordinator that was killed had begun to write, as it turned to its log: no reader may do that."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(path, timeout=5)) as connection:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()


def _is_locked(error: Exception) -> bool:
    """Whether another program keeps a journal to itself, such as SQLite's shell: nothing is wrong with it."""
    return isinstance(error, sqlite3.Error) and getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_BUSY


def _describe_with_remedy(error: Exception) -> str:
    """What is wrong, and what to do."""
    what = "end the program that keeps it locked" if _is_locked(error) else "restore it from a copy"
    return f"{one_line(str(error))}; {what}"


@contextmanager
def run_lock(path: Path) -> Iterator[None]:
    """Hold a run's folder: whoever writes in it, moves it or deletes it does so alone.

    The folder itself is locked beside the file that earlier versions lock: a file can be removed by hand. The journal
    is not, for to close another descriptor of it would end SQLite's own locks.
    """
    try:
        with ExitStack() as stack:
            file = stack.enter_context((path / "lock").open("w"))
            folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, folder)
            _flock(file.fileno(), path)
            with suppress(OSError):  # a network's file system may lock files alone
                _flock(folder, path)
            held = stack.pop_all()
    except OSError as error:
        raise JournalError(f"cannot write in {path}: {error.strerror}; choose another --runs-dir") from error
    with held:
        yield


def _has_live_holder(path: Path) -> bool:
    """Whether somebody holds a run's folder, as far as this host can tell; nothing is written."""
    import fcntl

    with suppress(OSError), (path / "lock").open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # for an instant: closed at once
        except BlockingIOError:
            return True
    return False


def _flock(descriptor: int, path: Path) -> None:
    import fcntl

    for pause in (*LOCK_RETRY_PAUSES, None):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if pause is None:
                raise UsageError(f"run {path.name} is held by a live coordinator; stop it first") from None
            time.sleep(pause)
