"""The jobs without a result: who holds them, in which order they are given, which failed. Pure."""

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from enum import Enum, auto

from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.failures import Failure, describe_job
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.protocol.messages import TAG_BYTES, Kind, Result
from dreamfleet.coordinator.dispatch.deficit_round_robin import DeficitCounter
from dreamfleet.coordinator.dispatch.failures import LONGEST_ERROR, WORKER_ENDED, Attempt, pause_before_retry
from dreamfleet.coordinator.jobs.checks import Check
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob

MAX_FAILED = 64  # failed attempts of a job that are remembered
MAX_NAMED = 4  # workers that the description of a failure names
MAX_HOLDERS = 2  # workers that a job is leased to at a time
SUSPECT_LOSSES = 2  # workers that ended while they held a job: it may be what ended them
NO_REASON = Failure("no fitness and no reason", "no reason")


class JobState(Enum):
    """The state of a wanted job; an accepted one is wanted no more (`PendingJobs.is_accepted`)."""

    QUEUED = auto()
    LEASED = auto()  # to one worker
    COPIED = auto()  # leased to two workers


@dataclass(slots=True)
class PendingJob:
    """A job without a result. A generation has many, so what most of them lack is shared."""

    work: ScoringJob
    order: int
    queued: int | None = None  # the order of its entry in a queue; the entry may outlive the state `QUEUED`
    holders: frozenset[str] = frozenset()  # workers that have a lease
    given_to: frozenset[str] = frozenset()  # workers that hold it or held it
    overrun_by: frozenset[str] = frozenset()  # workers that reported more steps than it can have
    attempts: tuple[Attempt, ...] = ()  # the failed ones
    lost_with: tuple[str, ...] = ()  # workers that ended while they held it
    is_control: bool = False  # a control job: it was scored before: who scores it again shows that a host can score
    check: Check | None = None  # it has an accepted result, which another host is to repeat
    retry_at: float = 0.0  # seconds of the monotonic clock before which it is not tried again
    # Workers that lost their lease, and the environment steps that each had made; `None`: it had finished.
    lost_steps: tuple[tuple[str, int | None], ...] = ()

    @property
    def state(self) -> JobState:
        """Its state, by the number of its holders."""
        if not self.holders:
            return JobState.QUEUED
        return JobState.LEASED if len(self.holders) < MAX_HOLDERS else JobState.COPIED

    @property
    def is_background(self) -> bool:
        """Whether it is an evaluation or a kept rollout: it uses idle slots, and a share of busy ones."""
        return self.work.template.kind != "score"

    @property
    def is_suspect(self) -> bool:
        """Whether it may be what ended the workers that held it."""
        return len(self.lost_with) >= SUSPECT_LOSSES and not self.is_control

    @property
    def avoided_workers(self) -> Set[str]:
        """Workers that get it again only if there is no other.

        R8: a job that failed is given to another worker.
        """
        return self.overrun_by.union(each.worker for each in self.attempts) if self.attempts else self.overrun_by

    def steps_lost_to(self, scorer: str, steps: int) -> int:
        """What former holders had done of the job that `scorer` has now scored in `steps`."""
        if not self.lost_steps:
            return 0
        gone = [made for worker, made in self.lost_steps if worker not in self.holders and worker != scorer]
        return sum(steps if made is None else min(made, steps) for made in gone)

    @property
    def errors(self) -> dict[str, str]:
        """The last error of each worker that failed it, in words."""
        return {each.worker: each.error.text for each in self.attempts}

    @property
    def attempts_by_worker(self) -> dict[str, int]:
        """How often it failed on each worker."""
        return dict(Counter(each.worker for each in self.attempts))

    def describe_failure(self) -> str:
        """What failed, on which workers, how often, and why, in one sentence."""
        job, errors, attempts = self.work.job, self.errors, self.attempts_by_worker
        names = list(errors)
        number = "two" if len(names) == 2 else str(len(names))
        where = "on one worker" if len(names) == 1 else f"on {number} workers"
        parts = [
            f"{name} ({'once' if attempts[name] == 1 else f'{attempts[name]} times'}): "
            f"{truncate(errors[name], LONGEST_ERROR)}"
            for name in names[:MAX_NAMED]
        ]
        more = [f"and {len(names) - MAX_NAMED} more"] if len(names) > MAX_NAMED else []
        subject = describe_job(job.kind, job.generation, job.candidate, job.seeds)
        return f"{subject}, failed {where}: {'; '.join(parts + more)}"


class PendingJobs(Mapping[bytes, PendingJob]):
    """Every wanted job by its digest. Workers are only names here."""

    def __init__(self, evaluation_share: float) -> None:
        # An earlier incarnation of the coordinator may have given jobs up to this generation.
        self.given_before_until = -1
        self._pending: dict[bytes, PendingJob] = {}
        self._tags: dict[bytes, bytes] = {}  # first bytes of a digest -> digest
        self._queue: list[tuple[int, bytes]] = []  # candidates' jobs, in order of offer
        self._background_queue: list[tuple[int, bytes]] = []
        self._share = DeficitCounter(evaluation_share)
        self._next_order = 0
        self.unmade = 0  # candidates' jobs of the open generation that are still to be offered
        self._background_held = 0  # background jobs with a holder
        self._failing: dict[bytes, PendingJob] = {}  # wanted jobs that failed somewhere
        self._waiting: set[bytes] = set()  # failing jobs before their next attempt
        self._accepted: dict[bytes, int] = {}  # digest -> generation, of this generation and the last
        self.checks: dict[bytes, PendingJob] = {}  # wanted jobs whose accepted result another host is to repeat
        self.is_drawn: Callable[[ScoringJob], bool] = lambda _: False  # whether a job's result is to be checked
        self.voter_of: Callable[[str], str] = host_of  # on whose word a worker's answer to a check stands

    def __getitem__(self, digest: bytes) -> PendingJob:
        return self._pending[digest]

    def __iter__(self) -> Iterator[bytes]:
        return iter(self._pending)

    def __len__(self) -> int:
        return len(self._pending)

    def work(self, digest: bytes) -> ScoringJob | None:
        """The work of a wanted job; `None` if it is not wanted."""
        pending = self._pending.get(digest)
        return None if pending is None else pending.work

    def digest_of_tag(self, tag: bytes) -> bytes | None:
        """The digest of the wanted job that begins with `tag`, as heartbeats name jobs."""
        return self._tags.get(tag)

    def may_have_been_given(self, digest: bytes, worker: str) -> bool:
        """Whether a worker may have a wanted job.

        R5: it was given the job in this incarnation; or an earlier one may have given it, to anybody.
        """
        pending = self._pending[digest]
        may_be_given_before = pending.check is None and pending.work.job.generation <= self.given_before_until
        return worker in pending.given_to or may_be_given_before

    def is_accepted(self, digest: bytes) -> bool:
        """Whether its result was accepted, in this generation or the last."""
        return digest in self._accepted

    @property
    def queue_length(self) -> int:
        """Candidates' jobs that wait, those included that are not made yet; an entry may outlive its job."""
        return len(self._queue) + self.unmade

    def offer(self, work: Iterable[ScoringJob]) -> None:
        """Want these jobs, except those that are wanted or accepted already.

        R3: a wanted job goes into the queue, so some worker will get it.
        """
        for each in work:
            if each.digest not in self._pending and each.digest not in self._accepted:
                self._add(PendingJob(each, self._next_order))

    def _add(self, pending: PendingJob) -> None:
        digest = pending.work.digest
        self._pending[digest] = pending
        self._tags[digest[:TAG_BYTES]] = digest
        self._next_order += 1
        self.enqueue(digest)

    def offer_control_job(self, work: ScoringJob) -> bool:
        """Want a job again that was scored before; `False` if it is wanted already."""
        digest = work.digest
        if digest in self._pending:
            return False
        self._add(PendingJob(work, self._next_order, is_control=True))
        return True

    def offer_check(self, work: ScoringJob, check: Check, holders: Iterable[str] = ()) -> None:
        """Want a job again whose result was accepted; the `holders` may finish it."""
        digest, pending = work.digest, PendingJob(work, self._next_order, check=check)
        self._pending[digest] = self.checks[digest] = pending
        self._tags[digest[:TAG_BYTES]] = digest
        for holder in holders:
            self.add_holder(digest, holder)

    def begin_generation(self, generation: int) -> None:
        """Forget the accepted jobs of generations before the last one.

        R26: the memory of accepted jobs is bounded; a result that arrives after its job was forgotten is obsolete.
        """
        self._accepted = {digest: number for digest, number in self._accepted.items() if number >= generation - 1}

    def digests_of_kind(self, kind: Kind) -> Sequence[bytes]:
        """The digests of the wanted jobs of a kind."""
        return [digest for digest, pending in self._pending.items() if pending.work.kind == kind]

    def plain_scores(self) -> Sequence[bytes]:
        """The digests of the wanted jobs of candidates that are no control jobs and no checks."""
        return [
            digest
            for digest, pending in self._pending.items()
            if not (pending.is_background or pending.is_control or pending.check)
        ]

    def enqueue(self, digest: bytes) -> None:
        """Put a wanted job into its queue: in order of offer, or behind the others if it failed; it may wait before."""
        pending = self._pending[digest]
        self._share.release(digest)
        if pending.check is not None:
            return  # it waits in `checks`
        if pending.retry_at:
            self._waiting.add(digest)
        elif pending.queued is None:
            pending.queued = pending.order
            heapq.heappush(self._background_queue if pending.is_background else self._queue, (pending.order, digest))

    def next(self, slots: int, *, idle: bool, drain_background: bool) -> tuple[bytes, bool] | None:
        """Take the next job from its queue; `None` if none may be given now.

        `slots` is the fleet's number of slots, `idle` whether one of them is. With `drain_background` background
        jobs may use all slots. The answer is the digest, and whether a background job goes before candidates' jobs.
        """
        while (next_job := self._next_queue(slots, idle=idle, drain_background=drain_background)) is not None:
            queue, by_share = next_job
            order, digest = heapq.heappop(queue)
            if (pending := self._pending.get(digest)) is None or pending.queued != order:
                continue  # answered or withdrawn meanwhile, and perhaps wanted again since, with an entry of its own
            pending.queued = None
            if pending.state is JobState.QUEUED:  # else a former holder has its lease again
                return digest, by_share
        return None

    def add_holder(self, digest: bytes, worker: str, *, by_share: bool = False) -> None:
        """Note that a worker has this job, or is about to be sent it."""
        pending = self._pending[digest]
        self._background_held += not pending.holders and pending.is_background
        pending.holders |= {worker}
        pending.given_to |= {worker}
        if by_share:
            self._share.reserve(digest)

    def remove_holder(self, digest: bytes, worker: str) -> bool:
        """Note that a worker has this job no more; return whether it was the last holder of a wanted job."""
        pending = self._pending.get(digest)
        if pending is None or worker not in pending.holders:
            return False
        pending.holders -= {worker}
        self._background_held -= not pending.holders and pending.is_background
        return not pending.holders

    def record_failure(self, worker: str, result: Result, now: float) -> None:
        """Note the error that a worker sent for a wanted job.

        R8: an error is no fitness; it decides who is given the job next and when, and whether the job has failed.
        """
        self._add_attempt(result.digest, Attempt(worker, result.error or NO_REASON), now)

    def record_loss(self, worker: str, digest: bytes, now: float) -> bool:
        """Note that a worker ended without a word while it held a wanted job; whether that counts as a failed attempt.

        R8: a job that was in hand at two such ends is a suspect. A worker gets one suspect at a time, so a further end
        is the failure of that one and not of its company.
        """
        pending = self._pending[digest]
        is_failure = pending.is_suspect or pending.is_control
        pending.lost_with = (*pending.lost_with, worker)
        if is_failure:
            self._add_attempt(digest, Attempt(worker, WORKER_ENDED), now)
        return is_failure

    def holders_of_suspects(self) -> set[str]:
        """The workers that hold a suspect."""
        return {name for each in self._pending.values() if each.is_suspect for name in each.holders}

    def forgive_losses(self, worker: str) -> None:
        """Forget the ends of a worker that is back: its link was cut."""
        for pending in self._pending.values():
            if worker in pending.lost_with:
                first = pending.lost_with.index(worker)
                pending.lost_with = pending.lost_with[:first] + pending.lost_with[first + 1 :]
                ended = Attempt(worker, WORKER_ENDED)
                pending.attempts = tuple(each for each in pending.attempts if each != ended)
        self._failing = {digest: pending for digest, pending in self._failing.items() if pending.attempts}

    def _add_attempt(self, digest: bytes, attempt: Attempt, now: float) -> None:
        pending = self._pending[digest]
        pending.attempts = (*pending.attempts, attempt)[-MAX_FAILED:]
        if pending.check is not None:
            pending.check.passed_over.add(self.voter_of(attempt.worker))
            return
        self._failing[digest] = pending
        pending.order, self._next_order = self._next_order, self._next_order + 1
        if pause := pause_before_retry(len(pending.attempts)):
            pending.retry_at = now + pause

    def enqueue_due(self, now: float) -> None:
        """Put failing jobs whose next attempt is due into their queues."""
        for digest in [each for each in self._waiting if self._pending[each].retry_at <= now]:
            self._release(digest)

    def _release(self, digest: bytes) -> None:
        self._waiting.discard(digest)
        self._pending[digest].retry_at = 0.0
        if self._pending[digest].state is JobState.QUEUED:
            self.enqueue(digest)

    def record_overrun(self, digest: bytes, worker: str) -> None:
        """Note that a worker reported more steps of this job than it can have."""
        self._pending[digest].overrun_by |= {worker}

    def record_lost_steps(self, digest: bytes, worker: str, steps: int | None) -> None:
        """Note what a worker that lost its lease of a wanted job had done; `None`: it had finished."""
        pending = self._pending[digest]
        pending.lost_steps = (*(each for each in pending.lost_steps if each[0] != worker), (worker, steps))

    def accept(self, result: Result) -> PendingJob:
        """Take a wanted job's first valid result, and want the job no more.

        R4: it is remembered as accepted, so a later result of it is a duplicate.
        """
        pending = self._pending[result.digest]
        self._share.charge(
            result.digest, result.seconds, is_background=pending.is_background, waiting=bool(self._background_queue)
        )
        self._accepted[result.digest] = pending.work.job.generation
        return self.remove(result.digest)

    def remove(self, digest: bytes) -> PendingJob:
        """Want a job no more; the returned job still names its holders."""
        pending = self._pending.pop(digest)
        self.checks.pop(digest, None)
        self._failing.pop(digest, None)
        self._waiting.discard(digest)
        self._tags.pop(digest[:TAG_BYTES], None)
        self._share.release(digest)
        self._background_held -= bool(pending.holders) and pending.is_background
        return pending

    @property
    def failures(self) -> list[PendingJob]:
        """Wanted jobs that failed somewhere."""
        return list(self._failing.values())

    def clear_failures(self) -> None:
        """Forget all failures, so that each job may be tried anew."""
        for digest, pending in self._failing.items():
            pending.attempts = ()
            if pending.retry_at:
                self._release(digest)
        self._failing.clear()

    def _next_queue(
        self, slots: int, *, idle: bool, drain_background: bool
    ) -> tuple[list[tuple[int, bytes]], bool] | None:
        """The queue that gives the next job, and whether that job goes by its share; `None` if none may be given.

        R18: background jobs get their share of busy slots, and of idle ones at most as many as their share holds:
        more would delay the next generation.
        """
        if self._queue:
            by_share = bool(self._background_queue) and self._share.is_due(slots)
            return (self._background_queue, True) if by_share else (self._queue, False)
        limit = max(1, int(slots * self._share.share))
        may_fill = idle and not self.unmade and self._background_held < limit
        if self._background_queue and (drain_background or may_fill):
            return self._background_queue, False
        return None
