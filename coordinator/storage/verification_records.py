"""What a journal holds of checked results: the key of the draw, the outcomes, and the hosts that are barred."""

from __future__ import annotations

import json
import secrets
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from time import time
from typing import Any, Literal

from dreamfleet.common.protocol.messages import Job, Kind
from dreamfleet.common.protocol.result_bounds import to_finite
from dreamfleet.coordinator.jobs.checks import Answer
from dreamfleet.coordinator.storage.batch_records import MOST_VARIABLES, BatchRecords

VERIFY_KEY = "verify_key"  # the fact's name
Outcome = Literal["equal", "differs", "unchecked"]
UNCHECKED = "AND NOT EXISTS (SELECT 1 FROM verification WHERE verification.digest = result.digest AND stands)"


@dataclass(frozen=True)
class StoredAnswer:
    """An accepted result as a check needs it."""

    worker: str
    host_class: str
    answer: Answer


@dataclass(frozen=True)
class StoredBar:
    """Why a host may not add to the run; `by_anchor`: only the coordinator's own host said so.

    `by_operator`: the operator named it, and no check found it wrong.
    """

    why: str
    by_anchor: bool = False
    by_operator: bool = False


class VerificationRecords(BatchRecords):
    """Reads and writes what a journal holds of checked results."""

    _digest_indices: dict[Kind, str]  # of each kind whose results are found by their digests, the index

    def verify_key(self) -> bytes:
        """The secret of the draw: it is the run's own, so that a restart draws the same results."""
        if self.fact(VERIFY_KEY) is None:
            self.set_fact(VERIFY_KEY, secrets.token_hex(32))
        return bytes.fromhex(self.fact(VERIFY_KEY) or "")

    def add_verification(self, job: Job, worker: str, checker: str, outcome: Outcome) -> None:
        """Write what came of checking the result of a job that `worker` brought; the `checker` is empty if none did."""
        self._write(
            "INSERT INTO verification (digest, kind, generation, worker, checker, outcome, happened) "
            "VALUES (?, ?, ?, ?, ?, ?, ?)",
            job.digest, job.kind, job.generation, worker, checker, outcome, time(),
        )  # fmt: skip

    def verification_counts(self) -> Counter[str]:
        """How many drawn results had each outcome, and `recalled` ones of barred hosts."""
        counts = Counter(dict(self._read("SELECT outcome, count(*) FROM verification GROUP BY 1")))
        (counts["recalled"],) = self._read_row("SELECT count(*) FROM recalled WHERE because = 'barred'")
        return counts

    def index_scores(self) -> None:
        """Let candidates' episodes be found by their digests alone, too: batches of others repeat them."""
        self._write("CREATE INDEX IF NOT EXISTS score_digest ON result (digest) WHERE kind = 'score'")
        self._digest_indices["score"] = "score_digest"

    def _with_digests(
        self, kind: Kind, columns: str, digests: Sequence[bytes], also: str = ""
    ) -> Iterator[tuple[Any, ...]]:
        """Read these columns of the results of a kind with these digests, whichever generation asked for them.

        The index is named, because SQLite would read all results of the kind.
        """
        for start in range(0, len(digests), MOST_VARIABLES):
            some = digests[start : start + MOST_VARIABLES]
            yield from self._read(
                f"SELECT {columns} FROM result INDEXED BY {self._digest_indices[kind]} "  # noqa: S608
                f"WHERE kind = '{kind}' AND digest IN ({', '.join('?' * len(some))}) {also}",
                *some,
            )

    def unverified(self, jobs: Sequence[Job]) -> dict[bytes, StoredAnswer]:
        """The accepted results of those of a generation's jobs that have one, and no outcome of a check; by digest."""
        if not jobs:
            return {}
        columns, kind = "digest, worker, host_class, fitness, steps, measures, seconds", jobs[0].kind
        wanted = {job.digest for job in jobs}
        if kind in self._digest_indices:
            rows: Iterable[tuple[Any, ...]] = self._with_digests(kind, columns, [*wanted], UNCHECKED)
        else:
            query = f"SELECT {columns} FROM result WHERE kind = ? AND generation = ? {UNCHECKED}"  # noqa: S608
            rows = self._read(query, kind, jobs[0].generation)
        found: dict[bytes, StoredAnswer] = {}
        for digest, worker, host_class, fitness, steps, measures, seconds in rows:
            if digest in wanted:
                measured = tuple(json.loads(measures or "[]"))
                answer = Answer(worker.partition("/")[0], to_finite(fitness), steps, measured, seconds)
                found[digest] = StoredAnswer(worker, host_class, answer)
        return found

    def barred(self) -> dict[str, StoredBar]:
        """The hosts that may not add to the run."""
        rows = self._read("SELECT host, why, by_anchor, by_operator FROM barred ORDER BY happened")
        return {host: StoredBar(why, bool(anchor), bool(operator)) for host, why, anchor, operator in rows}

    def bar(self, host: str, bar: StoredBar, incarnation: int) -> None:
        """Write that a host may not add to the run any more."""
        self._write(
            "INSERT OR REPLACE INTO barred (host, why, by_anchor, by_operator, incarnation, happened) "
            "VALUES (?, ?, ?, ?, ?, ?)",
            host, bar.why, int(bar.by_anchor), int(bar.by_operator), incarnation, time(),
        )  # fmt: skip

    def unbar(self, host: str) -> None:
        """Write that a host may add to the run again."""
        self._write("DELETE FROM barred WHERE host = ?", host)
