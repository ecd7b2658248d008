"""What a journal holds of checked results: the key of the draw, the outcomes, and the hosts that are barred."""

import json
import secrets
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from time import time
from typing import Any, Literal

from dreamfleet.common.protocol.messages import Job
from dreamfleet.common.protocol.result_bounds import to_finite
from dreamfleet.coordinator.storage.journal_connection import JournalConnection
from dreamfleet.coordinator.storage.result_records import ResultRecords

VERIFY_KEY = "verify_key"  # the fact's name
Outcome = Literal["equal", "differs", "unchecked"]  # docs/reference/metrics.md, addons/metrics/prometheus.py
UNCHECKED = "AND NOT EXISTS (SELECT 1 FROM verification WHERE verification.digest = result.digest AND stands)"


@dataclass(frozen=True)
class StoredAnswer:
    """An accepted result as a check needs it."""

    worker: str
    host_class: str
    value: tuple[float, int, tuple[float, ...]]  # as of an `Answer`
    seconds: float


@dataclass(frozen=True)
class StoredBar:
    """Why a host may not add to the run; `by_trusted`: only the coordinator's own host said so.

    `by_operator`: the operator named it, and no check found it wrong.
    """

    why: str
    by_trusted: bool = False
    by_operator: bool = False


class VerificationRecords:
    """Reads and writes what a journal holds of checked results."""

    def __init__(self, journal: JournalConnection, results: ResultRecords) -> None:
        self._journal = journal
        self._results = results

    def key(self) -> bytes:
        """The secret of the draw: it is the run's own, so that a restart draws the same results."""
        if (found := self._journal.fact(VERIFY_KEY)) is None:
            found = secrets.token_hex(32)
            self._journal.set_fact(VERIFY_KEY, found)
        return bytes.fromhex(found)

    def add(self, job: Job, worker: str, checker: str, outcome: Outcome) -> None:
        """Write the outcome of re-scoring a result of `worker`; the `checker` is empty if nobody did."""
        self._journal.insert(
            "verification", digest=job.digest, kind=job.kind, generation=job.generation, worker=worker,
            checker=checker, outcome=outcome, happened=time(),
        )  # fmt: skip

    def counts(self) -> Counter[str]:
        """How many drawn results had each outcome, and `recalled` ones of barred hosts."""
        counts = Counter(dict(self._journal.read("SELECT outcome, count(*) FROM verification GROUP BY 1")))
        (counts["recalled"],) = self._journal.read_row("SELECT count(*) FROM recalled WHERE because = 'barred'")
        return counts

    def unverified(self, jobs: Sequence[Job]) -> dict[bytes, StoredAnswer]:
        """The accepted results of those of a generation's jobs that have one, and no outcome of a check; by digest."""
        if not jobs:
            return {}
        columns, kind = "digest, worker, host_class, fitness, steps, measures, seconds", jobs[0].kind
        wanted = {job.digest for job in jobs}
        if kind in self._results.indices:
            rows: Iterable[tuple[Any, ...]] = self._results.with_digests(kind, columns, [*wanted], UNCHECKED)
        else:
            query = f"SELECT {columns} FROM result WHERE kind = ? AND generation = ? {UNCHECKED}"  # noqa: S608
            rows = self._journal.read(query, kind, jobs[0].generation)
        found: dict[bytes, StoredAnswer] = {}
        for digest, worker, host_class, fitness, steps, measures, seconds in rows:
            if digest in wanted:
                value = to_finite(fitness), steps, tuple(json.loads(measures or "[]"))
                found[digest] = StoredAnswer(worker, host_class, value, seconds)
        return found

    def barred(self) -> dict[str, StoredBar]:
        """The hosts that may not add to the run."""
        rows = self._journal.read("SELECT host, why, by_trusted, by_operator FROM barred ORDER BY happened")
        return {host: StoredBar(why, bool(trusted), bool(operator)) for host, why, trusted, operator in rows}

    def bar(self, host: str, bar: StoredBar, incarnation: int) -> None:
        """Write that a host may not add to the run any more."""
        self._journal.write(
            "INSERT OR REPLACE INTO barred (host, why, by_trusted, by_operator, incarnation, happened) "
            "VALUES (?, ?, ?, ?, ?, ?)",
            host, bar.why, int(bar.by_trusted), int(bar.by_operator), incarnation, time(),
        )  # fmt: skip

    def unbar(self, host: str) -> None:
        """Write that a host may add to the run again."""
        self._journal.write("DELETE FROM barred WHERE host = ?", host)
