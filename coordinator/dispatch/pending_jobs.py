"""The jobs without a result: who holds them, in which order they go, what failed, what was answered. Pure."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field

from dreamfleet.common.protocol.messages import TAG_BYTES, Kind, Result
from dreamfleet.coordinator.dispatch.deficit_round_robin import DeficitCounter
from dreamfleet.coordinator.dispatch.job_failure import JobFailure
from dreamfleet.coordinator.jobs.work import Work

MOST_FAILED = 16  # workers that a job's failures are remembered of; two pause the run
ATTEMPTS = 3  # of a failing job on one worker, where there is no other


@dataclass
class PendingJob:
    """A job without a result."""

    work: Work
    order: int
    queued: bool = False  # whether a queue names it, so that one does so once whatever its workers do
    holders: set[str] = field(default_factory=set)
    given_to: set[str] = field(default_factory=set)  # lives of workers that held it, now or before
    overrun: set[str] = field(default_factory=set)  # those that told more steps of it than it can have
    failed: dict[str, str] = field(default_factory=dict)  # worker -> error
    attempts: Counter[str] = field(default_factory=Counter)  # worker -> how often it failed there

    @property
    def is_background(self) -> bool:
        """Whether it fills what scoring leaves idle, and has a share of what it does not."""
        return self.work.job.kind != "score"

    @property
    def avoided_workers(self) -> Set[str]:
        """Who is given it again only where nobody else is there."""
        return self.failed.keys() | self.overrun

    @property
    def failure(self) -> JobFailure:
        """What failed so far."""
        return JobFailure(self.work, dict(self.failed), dict(self.attempts))


@dataclass(frozen=True)
class NextJob:
    """A job whose turn it is; `by_share`: before those that are scored."""

    digest: bytes
    by_share: bool


class PendingJobs(Mapping[bytes, PendingJob]):
    """Every wanted job by its digest. Workers are only names here."""

    def __init__(self, evaluation_share: float) -> None:
        self.previous_epoch_until = -1  # jobs up to this generation an earlier life of the coordinator may have given
        self._pending: dict[bytes, PendingJob] = {}
        self._tags: dict[bytes, bytes] = {}
        self._queue: list[tuple[int, bytes]] = []  # what is scored, in order of offer
        self._background_queue: list[tuple[int, bytes]] = []  # what waits for slack or for its share
        self._share = DeficitCounter(evaluation_share)
        self._next_order = 0
        self._background_held = 0  # evaluations and collected rollouts that somebody holds
        self._failing: dict[bytes, PendingJob] = {}  # those of the wanted that failed somewhere
        self._accepted: dict[bytes, int] = {}  # digest -> generation, of this one and the last

    def __getitem__(self, digest: bytes) -> PendingJob:
        return self._pending[digest]

    def __iter__(self) -> Iterator[bytes]:
        return iter(self._pending)

    def __len__(self) -> int:
        return len(self._pending)

    def work(self, digest: bytes) -> Work | None:
        """The work of a wanted job; `None` where it is not wanted."""
        pending = self._pending.get(digest)
        return None if pending is None else pending.work

    def digest_of_tag(self, tag: bytes) -> bytes | None:
        """The digest of the wanted job of which a beat tells the first bytes."""
        return self._tags.get(tag)

    def may_have_been_given(self, digest: bytes, worker: str) -> bool:
        """Whether a worker may have a wanted job: it was given to that very life, or may have been before ours."""
        pending = self._pending[digest]
        return worker in pending.given_to or pending.work.job.generation <= self.previous_epoch_until

    def is_accepted(self, digest: bytes) -> bool:
        """Whether its result has come, in this generation or the last."""
        return digest in self._accepted

    @property
    def queued(self) -> int:
        """Jobs that are scored and wait for a worker."""
        return len(self._queue)

    def offer(self, work: Iterable[Work]) -> None:
        """Want these jobs; what is wanted or accepted already is not offered twice."""
        for each in work:
            digest = each.job.digest
            if digest in self._pending or digest in self._accepted:
                continue
            self._pending[digest] = PendingJob(each, self._next_order)
            self._tags[digest[:TAG_BYTES]] = digest
            self._next_order += 1
            self.enqueue(digest)

    def begin_generation(self, generation: int) -> None:
        """A generation opens: what was accepted before the last one is forgotten."""
        self._accepted = {digest: number for digest, number in self._accepted.items() if number >= generation - 1}

    def digests_of_kind(self, kind: Kind) -> Sequence[bytes]:
        """The digests of the wanted jobs of a kind."""
        return [digest for digest, pending in self._pending.items() if pending.work.job.kind == kind]

    def enqueue(self, digest: bytes) -> None:
        """It waits for a worker, in order of offer."""
        pending = self._pending[digest]
        self._share.release(digest)
        if not pending.queued:
            pending.queued = True
            heapq.heappush(self._background_queue if pending.is_background else self._queue, (pending.order, digest))

    def next(self, slots: int, *, idle: bool, drain_background: bool) -> NextJob | None:
        """Take the next job from its queue; `None` where none may go now.

        `slots` is the fleet's number of slots, `idle` whether one of them is. With `drain_background` all take
        background jobs.
        """
        while (next_job := self._next_queue(slots, idle=idle, drain_background=drain_background)) is not None:
            queue, by_share = next_job
            _, digest = heapq.heappop(queue)
            if (pending := self._pending.get(digest)) is None:
                continue  # answered meanwhile
            pending.queued = False
            if not pending.holders:  # else adopted again from a worker that came back
                return NextJob(digest, by_share)
        return None

    def add_holder(self, digest: bytes, worker: str, *, by_share: bool = False) -> None:
        """A worker has this job, or is about to be sent it."""
        pending = self._pending[digest]
        self._background_held += pending.is_background and not pending.holders
        pending.holders.add(worker)
        pending.given_to.add(worker)
        if by_share:
            self._share.reserve(digest)

    def remove_holder(self, digest: bytes, worker: str) -> bool:
        """A worker has this job no more; whether it was the last one."""
        pending = self._pending.get(digest)
        if pending is None or worker not in pending.holders:
            return False
        pending.holders.discard(worker)
        self._background_held -= pending.is_background and not pending.holders
        return not pending.holders

    def record_failure(self, worker: str, result: Result) -> None:
        """A wanted job gave an error instead of a fitness."""
        pending = self._failing[result.digest] = self._pending[result.digest]
        if worker in pending.failed or len(pending.failed) < MOST_FAILED:
            pending.attempts[worker] += 1
            pending.failed[worker] = result.error or "no fitness and no reason"

    def overrun(self, digest: bytes, worker: str) -> None:
        """A worker told more steps of this job than it can have."""
        self._pending[digest].overrun.add(worker)

    def accept(self, result: Result) -> PendingJob:
        """A wanted job's first valid result: it is wanted no more."""
        pending = self._pending[result.digest]
        self._share.charge(
            result.digest, result.seconds, is_background=pending.is_background, waiting=bool(self._background_queue)
        )
        self._accepted[result.digest] = pending.work.job.generation
        return self.remove(result.digest)

    def remove(self, digest: bytes) -> PendingJob:
        """Want a job no more; it still says who holds it."""
        pending = self._pending.pop(digest)
        self._failing.pop(digest, None)
        self._tags.pop(digest[:TAG_BYTES], None)
        self._share.release(digest)
        self._background_held -= pending.is_background and bool(pending.holders)
        return pending

    @property
    def failures(self) -> list[JobFailure]:
        """Wanted jobs that failed somewhere."""
        return [pending.failure for pending in self._failing.values()]

    def find_poison_job(self) -> JobFailure | None:
        """A job that failed on two different workers, or again and again on the only one there is."""
        for pending in self._failing.values():
            if len(pending.failed) > 1 or any(count >= ATTEMPTS for count in pending.attempts.values()):
                return pending.failure
        return None

    def clear_failures(self) -> None:
        """Forget what failed."""
        for pending in self._failing.values():
            pending.failed.clear()
            pending.attempts.clear()
        self._failing.clear()

    def _next_queue(
        self, slots: int, *, idle: bool, drain_background: bool
    ) -> tuple[list[tuple[int, bytes]], bool] | None:
        """The queue that gives the next job, and whether that job goes by its share; `None` where none may go."""
        if self._queue:
            by_share = bool(self._background_queue) and self._share.is_due(slots)
            return (self._background_queue, True) if by_share else (self._queue, False)
        most = max(1, int(slots * self._share.share))  # more in idle slots would keep the next generation waiting
        if self._background_queue and (drain_background or (idle and self._background_held < most)):
            return self._background_queue, False
        return None
