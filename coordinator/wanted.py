"""The jobs without a result: who holds them, in which order they go, what failed, what was answered. Pure."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field

from dreamfleet.common.messages import TAG_BYTES, Kind, Result
from dreamfleet.coordinator.failure import Failure
from dreamfleet.coordinator.jobs import Work
from dreamfleet.coordinator.share import Share

MOST_FAILED = 16  # workers that a job's failures are remembered of; two pause the run
ATTEMPTS = 3  # of a failing job on one worker, where there is no other


@dataclass
class Wanted:
    """A job without a result."""

    work: Work
    order: int
    queued: bool = False  # whether a queue names it, so that one does so once whatever its workers do
    holders: set[str] = field(default_factory=set)
    given: set[str] = field(default_factory=set)  # lives of workers that held it, now or before
    overrun: set[str] = field(default_factory=set)  # those that told more steps of it than it can have
    failed: dict[str, str] = field(default_factory=dict)  # worker -> error
    attempts: Counter[str] = field(default_factory=Counter)  # worker -> how often it failed there

    @property
    def in_slack(self) -> bool:
        """Whether it fills what scoring leaves idle, and has a share of what it does not."""
        return self.work.job.kind != "score"

    @property
    def shunned(self) -> Set[str]:
        """Who is given it again only where nobody else is there."""
        return self.failed.keys() | self.overrun

    @property
    def failure(self) -> Failure:
        """What failed so far."""
        return Failure(self.work, dict(self.failed), dict(self.attempts))


@dataclass(frozen=True)
class Turn:
    """A job whose turn it is; `by_share`: before those that are scored."""

    digest: bytes
    by_share: bool


class WantedJobs(Mapping[bytes, Wanted]):
    """Every wanted job by its digest. Workers are only names here."""

    def __init__(self, evaluation_share: float) -> None:
        self.earlier = -1  # jobs up to this generation an earlier life of the coordinator may have given
        self._wanted: dict[bytes, Wanted] = {}
        self._tags: dict[bytes, bytes] = {}
        self._queue: list[tuple[int, bytes]] = []  # what is scored, in order of offer
        self._spare: list[tuple[int, bytes]] = []  # what waits for slack or for its share
        self._share = Share(evaluation_share)
        self._orders = 0
        self._in_slack = 0  # evaluations and collected rollouts that somebody holds
        self._failing: dict[bytes, Wanted] = {}  # those of the wanted that failed somewhere
        self._accepted: dict[bytes, int] = {}  # digest -> generation, of this one and the last

    def __getitem__(self, digest: bytes) -> Wanted:
        return self._wanted[digest]

    def __iter__(self) -> Iterator[bytes]:
        return iter(self._wanted)

    def __len__(self) -> int:
        return len(self._wanted)

    def work(self, digest: bytes) -> Work | None:
        """The work of a wanted job; `None` where it is not wanted."""
        wanted = self._wanted.get(digest)
        return None if wanted is None else wanted.work

    def named(self, tag: bytes) -> bytes | None:
        """The digest of the wanted job of which a beat tells the first bytes."""
        return self._tags.get(tag)

    def may_have(self, digest: bytes, worker: str) -> bool:
        """Whether a worker may have a wanted job: it was given to that very life, or may have been before ours."""
        wanted = self._wanted[digest]
        return worker in wanted.given or wanted.work.job.generation <= self.earlier

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
            if digest in self._wanted or digest in self._accepted:
                continue
            self._wanted[digest] = Wanted(each, self._orders)
            self._tags[digest[:TAG_BYTES]] = digest
            self._orders += 1
            self.enqueue(digest)

    def begin(self, generation: int) -> None:
        """A generation opens: what was accepted before the last one is forgotten."""
        self._accepted = {digest: number for digest, number in self._accepted.items() if number >= generation - 1}

    def of_kind(self, kind: Kind) -> Sequence[bytes]:
        """The digests of the wanted jobs of a kind."""
        return [digest for digest, wanted in self._wanted.items() if wanted.work.job.kind == kind]

    def enqueue(self, digest: bytes) -> None:
        """It waits for a worker, in order of offer."""
        wanted = self._wanted[digest]
        self._share.give_back(digest)
        if not wanted.queued:
            wanted.queued = True
            heapq.heappush(self._spare if wanted.in_slack else self._queue, (wanted.order, digest))

    def next(self, slots: int, *, idle: bool, hurry: bool) -> Turn | None:
        """Take the next job from its queue; `None` where none may go now.

        `slots` is the fleet's, `idle` says whether one of them is; in a `hurry` all slots are for what fills slack.
        """
        while (turn := self._whose(slots, idle=idle, hurry=hurry)) is not None:
            queue, by_share = turn
            _, digest = heapq.heappop(queue)
            if (wanted := self._wanted.get(digest)) is None:
                continue  # answered meanwhile
            wanted.queued = False
            if not wanted.holders:  # else adopted again from a worker that came back
                return Turn(digest, by_share)
        return None

    def hold(self, digest: bytes, worker: str, *, by_share: bool = False) -> None:
        """A worker has this job, or is about to be sent it."""
        wanted = self._wanted[digest]
        self._in_slack += wanted.in_slack and not wanted.holders
        wanted.holders.add(worker)
        wanted.given.add(worker)
        if by_share:
            self._share.take(digest)

    def let_go(self, digest: bytes, worker: str) -> bool:
        """A worker has this job no more; whether it was the last one."""
        wanted = self._wanted.get(digest)
        if wanted is None or worker not in wanted.holders:
            return False
        wanted.holders.discard(worker)
        self._in_slack -= wanted.in_slack and not wanted.holders
        return not wanted.holders

    def fail(self, worker: str, result: Result) -> None:
        """A wanted job gave an error instead of a fitness."""
        wanted = self._failing[result.digest] = self._wanted[result.digest]
        if worker in wanted.failed or len(wanted.failed) < MOST_FAILED:
            wanted.attempts[worker] += 1
            wanted.failed[worker] = result.error or "no fitness and no reason"

    def overrun(self, digest: bytes, worker: str) -> None:
        """A worker told more steps of this job than it can have."""
        self._wanted[digest].overrun.add(worker)

    def accept(self, result: Result) -> Wanted:
        """A wanted job's first valid result: it is wanted no more."""
        wanted = self._wanted[result.digest]
        self._share.count(result.digest, result.seconds, in_slack=wanted.in_slack, waiting=bool(self._spare))
        self._accepted[result.digest] = wanted.work.job.generation
        return self.remove(result.digest)

    def remove(self, digest: bytes) -> Wanted:
        """Want a job no more; it still says who holds it."""
        wanted = self._wanted.pop(digest)
        self._failing.pop(digest, None)
        self._tags.pop(digest[:TAG_BYTES], None)
        self._share.give_back(digest)
        self._in_slack -= wanted.in_slack and bool(wanted.holders)
        return wanted

    @property
    def failures(self) -> list[Failure]:
        """Wanted jobs that failed somewhere."""
        return [wanted.failure for wanted in self._failing.values()]

    def poison(self) -> Failure | None:
        """A job that failed on two different workers, or again and again on the only one there is."""
        for wanted in self._failing.values():
            if len(wanted.failed) > 1 or any(count >= ATTEMPTS for count in wanted.attempts.values()):
                return wanted.failure
        return None

    def pardon(self) -> None:
        """Forget what failed."""
        for wanted in self._failing.values():
            wanted.failed.clear()
            wanted.attempts.clear()
        self._failing.clear()

    def _whose(self, slots: int, *, idle: bool, hurry: bool) -> tuple[list[tuple[int, bytes]], bool] | None:
        """The queue that gives the next job, and whether that job goes by its share; `None` where none may go."""
        if self._queue:
            by_share = bool(self._spare) and self._share.due(slots)
            return (self._spare, True) if by_share else (self._queue, False)
        most = max(1, int(slots * self._share.share))  # more in idle slots would keep the next generation waiting
        if self._spare and (hurry or (idle and self._in_slack < most)):
            return self._spare, False
        return None
