"""One life of a worker: the product's `Membership`, `Backlog`, `Outbox` and `UploadQueue`, as `RunSession` turns them.

The only module that knows how the worker's parts are driven. Its slots are simulated: a turn takes virtual time, and
gives what `truth.py` says that its vectors and seeds give.
"""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.host_classes import class_from_fingerprint
from dreamfleet.common.protocol.keys import PROTOCOL_VERSION
from dreamfleet.common.protocol.messages import (
    MAX_LEASES,
    TAG_BYTES,
    Heartbeat,
    HelloRequest,
    Job,
    JobBatch,
    Result,
    ResultBatch,
    RunningJob,
    TaskSpec,
    UploadPart,
)
from dreamfleet.common.security.host_key import token_for
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.membership import LeaveConditions, Membership, WorkerLoad
from dreamfleet.worker.service.outbox import BURST_INTERVAL, Outbox, UploadQueue
from tests.simulation.coordinator import BEAT, HOST_KEY, REPEAT
from tests.simulation.schedule import Shape
from tests.simulation.truth import STEPS, TASK, fitness_of, rollout_of
from tests.simulation.truth import fails as truth_fails
from tests.simulation.violation import Violation
from tests.support.failures import failure

UID = "0123456789abcdef" * 2
HELLO_TIMEOUT = 2.0
RETRY = 1.0


@dataclass(frozen=True)
class Welcome:
    """The coordinator's answer to hello number `question`."""

    nonce: str
    question: int
    numbering: int


@dataclass(frozen=True)
class Token:
    """A coordinator came into sight, or went out of it."""

    nonce: str
    there: bool


@dataclass
class Turn:
    """Jobs in a slot's hands."""

    work: Sequence[tuple[Job, bytes]]
    began: float
    ends: float
    unwanted: set[bytes] = field(default_factory=set)

    def steps(self, now: float) -> int:
        """Of each of its jobs so far."""
        return int(STEPS * min((now - self.began) / (self.ends - self.began), 1.0))


@dataclass
class Scored:
    """What everybody's slots did, for the reckoning at the end."""

    steps: int = 0
    errors: int = 0
    failures: int = 0  # attempts of episodes that fail wherever they are scored


class Worker:
    """`send` puts a message on the wire; `speed` says how many times slower than usual its slots are now."""

    def __init__(
        self, identity: str, shape: Shape, spec: TaskSpec, now: float, send: Callable[[Any], None], scored: Scored
    ) -> None:
        self.identity = identity
        self.stopped = False
        self.left = False
        self.slowness = 1.0
        self.lie: Callable[[Job, float], float] = lambda _, fitness: fitness  # what it says of a job
        self.host_class = class_from_fingerprint("f")
        self.is_trusted = False  # whether it is on the coordinator's own host
        self.failures = 0  # turns that are still to fail
        self.nonce: str | None = None  # of the life that it has joined; `None` before the first
        self.inbox: deque[Any] = deque()
        self.membership = Membership(LeaveConditions(drain_timeout=20.0), now)
        self._shape = shape
        self._spec = spec
        self._send = send
        self._scored = scored
        self.asked_at = self.awake_since = now
        self._question = 0
        self._waits_until: float | None = None  # for the answer to hello
        self._retry_at = now
        self._jitter = 0.7 + 0.1 * (sum(identity.encode()) % 7)
        self._begin()

    def _begin(self) -> None:
        self.backlog, self.outbox, self.uploads = Backlog(self._spec), Outbox(REPEAT), UploadQueue(REPEAT)
        self.turns: list[Turn | None] = [None] * self._shape.slots
        self.sent_at: dict[bytes, float] = {}  # when each result was last sent
        self._given: Counter[bytes] = Counter()  # in how many batches each job came
        self._begun: Counter[bytes] = Counter()
        self._batches: set[tuple[int, int]] = set()  # that have come, by numbering
        self._beat_at = 0.0

    @property
    def asking(self) -> bool:
        """Whether it does nothing but wait for an answer to hello."""
        return self._waits_until is not None

    @property
    def capacity(self) -> int:
        """Jobs that it scores at once."""
        return min(self._shape.slots * self._shape.width, MAX_LEASES // 2)

    @property
    def undelivered(self) -> int:
        """What it holds in all: at rest nothing."""
        return len(self.outbox) + len(self.uploads) + len(self.backlog.queued) + sum(map(bool, self.turns))

    def wakes_at(self, now: float) -> float:
        """When it does something next though nothing comes."""
        if self._waits_until is not None:
            return self._waits_until
        if self.nonce is None:
            return self._retry_at
        at = self._beat_at
        if len(self.outbox):
            at = min(at, now + REPEAT / 4)
        if len(self.uploads):
            at = min(at, now + BURST_INTERVAL)
        return min([at, *(turn.ends for turn in self.turns if turn)])

    def answer(self, welcome: Welcome, now: float) -> None:
        """An answer to hello; one that comes too late is not listened to."""
        if self._waits_until is None or welcome.question != self._question:
            return
        self._waits_until = None
        if self.nonce is None:
            self.nonce = welcome.nonce
            self.backlog.start_numbering(welcome.numbering)
            self.membership.join(welcome.nonce, BEAT, now)
            return
        if welcome.nonce != self.nonce or welcome.numbering != self.backlog.numbering:
            self._begin_numbering(welcome.numbering)
        self.nonce = welcome.nonce
        self.membership.rejoin(welcome.nonce, now)

    def _begin_numbering(self, numbering: int) -> None:
        self._batches.clear()
        self.backlog.start_numbering(numbering)
        self.backlog.clear()
        if self.backlog.seen:
            raise Violation("books", f"a worker begins a new numbering with {self.backlog.seen} batches seen")
        self.outbox.resend_all()
        self.uploads.resend_all()
        self._beat_at = 0.0

    def turn(self, now: float) -> None:
        """A turn of its loop."""
        if self._waits_until is not None:
            if now < self._waits_until:
                return
            self._waits_until = None  # nobody answered
            self._retry_at = now + RETRY * self._jitter
        if self.nonce is None:
            if self.membership.is_leaving(now):
                self.left = True
            elif now >= self._retry_at:
                self._ask(now)
            return
        self._work(now)

    def _work(self, now: float) -> None:
        while self.inbox:
            self._take(self.inbox.popleft(), now)
        self._end_turns(now)
        if self.membership.start_draining_if_due(now):
            self.backlog.clear()
        self._fill(now)
        self._say(now)
        idle, awaits_verdict = not any(self.turns), len(self.outbox) > 0
        hands = WorkerLoad(idle=idle, awaits_verdict=awaits_verdict, uploading=len(self.uploads) > 0)
        if self.membership.must_rejoin(now, hands):
            self.membership.note_hello_sent(now, RETRY * self._jitter)
            self._ask(now)
        self.left = bool(self.membership.find_end(now, busy=any(self.turns) or len(self.outbox) > 0))

    def _ask(self, now: float) -> None:
        self._question += 1
        self.asked_at = now
        self._waits_until = now + HELLO_TIMEOUT
        host_token = token_for(HOST_KEY, self.identity) if self.is_trusted else ""
        offered = self.identity, (TASK,), "f", self._shape.slots, NUMERIC_PACKAGES
        versions = PROTOCOL_VERSION, PROTOCOL_VERSION, "0"
        request = HelloRequest(*versions, *offered, host_class=self.host_class, host_token=host_token)
        self._send((request, self._question))

    def _take(self, event: JobBatch | Token, now: float) -> None:
        if isinstance(event, Token):
            if event.there:
                self.membership.add_coordinator(event.nonce)
            else:
                self.membership.remove_coordinator(event.nonce, now)
            return
        if event.nonce != self.nonce or event.numbering < self.backlog.numbering:
            return
        if event.numbering > self.backlog.numbering:
            self.membership.suspect_forgotten()
            return
        self.membership.note_activity(now)
        self._note(event)
        for digest in event.cancels:
            self._abandon(digest, now)
        for job, why in self.backlog.add_batch(event, self._held):
            self.outbox.add(Result(job.digest, None, 0, 0.0, why, None))
        judged = [verdict.digest for verdict in event.verdicts]
        awaits_verdict = self.outbox.digests
        self.outbox.acknowledge(judged)
        if self.outbox.digests != [digest for digest in awaits_verdict if digest not in judged]:
            raise Violation("books", "a verdict does not end the repetition of its own result alone")
        self.uploads.acknowledge(judged)
        if self.membership.draining:
            self.backlog.clear()

    @property
    def _held(self) -> set[bytes]:
        turns = [turn for turn in self.turns if turn is not None]
        return {job.digest for turn in turns for job, _ in turn.work if job.digest not in turn.unwanted}

    def _note(self, batch: JobBatch) -> None:
        """A batch counts once in a numbering; so many times may each of its jobs be begun."""
        name = batch.numbering, batch.number
        if name not in self._batches:
            self._batches.add(name)
            self._given.update(job.digest for job in batch.jobs)

    def _abandon(self, digest: bytes, now: float) -> None:
        """A turn without a wanted job ends at its next step."""
        for number, turn in enumerate(self.turns):
            if turn is not None and any(job.digest == digest for job, _ in turn.work):
                turn.unwanted.add(digest)
                if len(turn.unwanted) == len(turn.work):
                    self._scored.steps += turn.steps(now) * len(turn.work)
                    self.turns[number] = None

    def _end_turns(self, now: float) -> None:
        for number, turn in enumerate(self.turns):
            if turn is not None and turn.ends <= now:
                self.turns[number] = None
                self.membership.note_activity(now)
                self._end(turn)

    def _end(self, turn: Turn) -> None:
        fails = self.failures > 0
        self.failures -= fails
        self._scored.steps += STEPS * len(turn.work)
        for job, vector in turn.work:
            if fails:
                self._scored.errors += 1  # of the host, where failures become facts
                error = Failure.of_host("boom") if self._shape.on_failure != "pause" else failure("boom")
                self.outbox.add(Result(job.digest, None, STEPS, 0.1, error, None))
                continue
            if job.kind == "score" and truth_fails(self._shape.failing, job.vector, job.seeds[0]):
                self._scored.failures += 1
                self.outbox.add(Result(job.digest, None, STEPS, 0.1, failure("ValueError", f"at {turn.ends}"), None))
                continue
            fitness, upload = self.lie(job, fitness_of(vector, job.seeds[0], job.overrides)), None
            if job.kind == "collect":
                data = rollout_of(vector, job.seeds[0], self._shape.rollout)
                self.uploads.add(job.digest, data)
                upload = hashlib.sha256(data).digest()
            self.outbox.add(Result(job.digest, fitness, STEPS, 0.1 + 1e-6 * turn.ends, None, upload))

    def _fill(self, now: float) -> None:
        if self.membership.is_leaving(now):
            return
        room = 4 * self._shape.slots * self._shape.width - len(self.outbox)
        for number, turn in enumerate(self.turns):
            if turn is None and room >= 0 and (work := self.backlog.take(self._shape.width)):
                self.turns[number] = Turn(work, now, now + self._shape.turn * self.slowness)
                self._begun.update(job.digest for job, _ in work)
                if any(self._begun[job.digest] > self._given[job.digest] for job, _ in work):
                    raise Violation("waste", "a worker begins a job more often than it was given")

    def _say(self, now: float) -> None:
        head = {"run_uid": UID, "incarnation": 1}
        if now >= self._beat_at:
            self._beat_at = now + BEAT
            self._send(self._beat(now))
        for results in self.outbox.due(now):
            self._send(ResultBatch(**head, fingerprint="f", results=results, host_class=self.host_class))
            self.sent_at.update((result.digest, now) for result in results)
        for piece in self.uploads.due(now):
            self._send(UploadPart(**head, **vars(piece)))

    def _beat(self, now: float) -> Heartbeat:
        running = [(job.digest, turn.steps(now)) for turn in self.turns if turn for job, _ in turn.work]
        return Heartbeat(
            run_uid=UID,
            incarnation=1,
            nonce=self.nonce or "",
            numbering=self.backlog.numbering,
            seen=self.backlog.seen,
            capacity=0 if self.membership.draining else self.capacity,
            slots=self._shape.slots,
            queued=tuple(digest[:TAG_BYTES] for digest in self.backlog.queued),
            running=tuple(RunningJob(digest[:TAG_BYTES], steps) for digest, steps in running),
            unacked=tuple(digest[:TAG_BYTES] for digest in self.outbox.digests[:MAX_LEASES]),
            load=0.0,
            steps_per_second=STEPS / self._shape.turn / self.slowness * len(running),
            drawn_by="-",
            host_class=self.host_class,
        )
