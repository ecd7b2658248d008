"""What a journal holds of checked results: the key of the draw, the outcomes, and the hosts that are barred."""

from __future__ import annotations

import json
import secrets
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from time import time
from typing import Literal

from dreamfleet.common.protocol.host_classes import class_from_fingerprint
from dreamfleet.common.protocol.messages import Job
from dreamfleet.common.protocol.result_bounds import to_finite
from dreamfleet.coordinator.jobs.checks import Answer
from dreamfleet.coordinator.storage.batch_records import MOST_VARIABLES, BatchRecords

VERIFY_KEY = "verify_key"  # the fact's name
Outcome = Literal["equal", "differs", "unchecked"]


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

    def unverified(self, jobs: Sequence[Job]) -> dict[bytes, StoredAnswer]:
        """The accepted results of those of a generation's jobs that have one, and no outcome of a check; by digest."""
        found: dict[bytes, StoredAnswer] = {}
        for start in range(0, len(jobs), MOST_VARIABLES):
            some = [job.digest for job in jobs[start : start + MOST_VARIABLES]]
            # A mean's evaluation may have been asked for by another generation.
            among = "kind = 'evaluate'" if jobs[0].kind == "evaluate" else "kind = 'score' AND generation = ?"
            values = some if jobs[0].kind == "evaluate" else [jobs[0].generation, *some]
            query = (
                "SELECT digest, worker, host_class, fingerprint, fitness, steps, measures, seconds FROM result WHERE "  # noqa: S608
                f"{among} AND digest IN ({', '.join('?' * len(some))}) "
                "AND digest NOT IN (SELECT digest FROM verification WHERE stands)"
            )
            for digest, worker, host_class, fingerprint, fitness, steps, measures, seconds in self._read(
                query, *values
            ):
                measured = tuple(json.loads(measures or "[]"))
                answer = Answer(worker.partition("/")[0], to_finite(fitness), steps, measured, seconds)
                found[digest] = StoredAnswer(worker, host_class or class_from_fingerprint(fingerprint), answer)
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
