"""A simulated fleet: the real `Fleet`, and hosts with simulated time and network."""

import heapq
from collections import Counter
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from msgspec.structs import replace

from dreamfleet.common.protocol.messages import Job, Result
from dreamfleet.coordinator.jobs.scoring_job import make_jobs, vector_bytes
from tests.support.dispatched import Fleet, beat, work
from tests.support.samples import SPEC

TICK = 0.05
JOB_BYTES = 300
SILENT_BEATS = 5  # after which an idle worker sends hello again


@dataclass
class Turn:
    """Jobs that a slot scores together."""

    jobs: list[Job]
    seconds: float
    until: float


@dataclass
class Host:
    """A worker; a turn of one of its slots takes `turn` seconds, and those of `row` for each job by its kind."""

    name: str
    row: dict[str, float]
    slots: int = 1
    width: int = 1  # candidates that a slot scores together
    turn: float = 0.0
    delay: float = 0.0005  # seconds each way
    bandwidth: float = 1e8  # bytes a second, to the host
    lives: float = 0.0  # seconds until it is killed and, a second later, restarted; 0: never
    identity: str = ""
    seen: set[int] = field(default_factory=set)
    queued: dict[bytes, Job] = field(default_factory=dict)
    turns: list[Turn] = field(default_factory=list)
    unacked: dict[bytes, None] = field(default_factory=dict)
    heard: float = 0.0
    busy_until: float = 0.0  # its network link


class Played:
    """A simulated run.

    `seconds` lists how long each generation took, `closed` when each was, `spent` the slots' seconds by kind of job.
    `evaluations` says how many episodes of an evaluation begin with a generation; `done` is when each was finished.
    """

    def __init__(self, *hosts, population=16, episodes=4, size=64, evaluations=lambda generation: 0, **how):
        self.fleet = Fleet(1.0, **how)
        self.hosts = hosts
        self.seconds, self.closed, self.spent, self.done = [], [], Counter(), {}
        self._population, self._episodes, self._size, self._evaluations = population, episodes, size, evaluations
        self.now, self._order, self._events = 0.0, count(), []
        self._open, self._evaluated, self._is_due = set(), {}, False
        self._next_generation()
        for host in hosts:
            self._at(0.0, self._start, host)
        self._at(0.0, self._tick)

    def play(self, generations):
        """Run until so many generations are closed; return the seconds of each."""
        while len(self.seconds) < generations:
            self.now, _, action, arguments = heapq.heappop(self._events)
            assert self.now < 10_000.0, f"{len(self.seconds)} generations"
            action(*arguments)
            if self._is_due and self._events[0][0] > self.now:  # all results of this moment have come
                self._dispatch()
        return self.seconds

    def _at(self, when, action, *arguments):
        heapq.heappush(self._events, (when, next(self._order), action, arguments))

    def _next_generation(self):
        number, self._begun = len(self.seconds), self.now
        if number and (episodes := self._evaluations(number)):
            evaluation = work(episodes, "evaluate", number)
            self._evaluated[number] = {each.digest for each in evaluation}
            self.fleet.jobs.offer(evaluation)
        self.fleet.jobs.begin_generation(number)
        for candidate in range(self._population):
            vector = vector_bytes(np.arange(float(self._size)) + candidate + number * 1000)
            jobs = make_jobs(SPEC, "score", number, candidate, vector, range(1000, 1000 + self._episodes))
            self._open |= {each.digest for each in jobs}
            self.fleet.jobs.offer(jobs)

    def _tick(self):
        self._dispatch()
        self._at(self.now + TICK, self._tick)

    def _dispatch(self):
        self._is_due = False
        self.fleet.tick(self.now)
        for send in self.fleet.dispatch(self.now):
            self._send(send)
        self.fleet.notes.clear()

    def _send(self, send):
        host = next((host for host in self.hosts if host.identity == send.identity), None)
        if host is not None:
            size = 200 + sum(len(part.data) for part in send.vectors) + JOB_BYTES * len(send.work)
            size += 40 * (len(send.cancels) + len(send.verdicts))
            host.busy_until = max(host.busy_until, self.now) + size / host.bandwidth
            self._at(host.busy_until + host.delay, self._arrive, host, send)

    def _start(self, host):
        host.identity = f"{host.name}/{next(self._order):08x}"
        host.turns, host.unacked = [], {}
        self._join(host)
        self._at(self.now, self._beat_of, host, host.identity)
        if host.lives:
            self._at(self.now + host.lives, self._kill, host)

    def _kill(self, host):
        self.fleet.handle_departure(host.identity, self.now)
        host.identity = ""
        self._at(self.now + 1.0, self._start, host)

    def _join(self, host):
        host.seen, host.queued, host.heard = set(), {}, self.now
        host.numbering = self.fleet.add_worker(host.identity, host.slots, "f", self.now)

    def _arrive(self, host, send):
        if host.identity != send.identity:
            return
        host.heard = self.now
        if send.number in host.seen or not send.number:
            return
        host.seen.add(send.number)
        for digest in send.cancels:
            host.queued.pop(digest, None)
            if host.width == 1:
                host.turns = [turn for turn in host.turns if turn.jobs[0].digest != digest]
        for verdict in send.verdicts:
            host.unacked.pop(verdict.digest, None)
        host.queued |= {each.digest: each.job for each in send.work}
        self._fill(host)

    def _fill(self, host):
        while len(host.turns) < host.slots and host.queued:
            first, *others = host.queued.values()
            jobs = [first]
            for job in others[: host.width - 1]:
                if first.kind != "score" or job.kind != "score":
                    break
                jobs.append(job)
            for job in jobs:
                del host.queued[job.digest]
            seconds = host.turn + sum(host.row[job.kind] for job in jobs)
            host.turns.append(Turn(jobs, seconds, self.now + seconds))
            self._at(self.now + seconds, self._finish, host, host.turns[-1])

    def _finish(self, host, turn):
        if not any(turn is each for each in host.turns):  # it was cancelled, or the host killed
            return
        host.heard = self.now
        host.turns = [each for each in host.turns if each is not turn]
        host.unacked |= dict.fromkeys(job.digest for job in turn.jobs)
        each = turn.seconds / len(turn.jobs)
        for job in turn.jobs:
            self.spent[job.kind] += each
        self._at(self.now + host.delay, self._receive, host.identity, turn.jobs, each)
        self._fill(host)

    def _receive(self, identity, jobs, seconds):
        for job in jobs:
            result = Result(job.digest, 1.0, 10, seconds, None, None)
            if self.fleet.handle_result(identity, result, self.now)[0] == "accepted":
                self._count(job)
        while not self._open:
            self.seconds.append(self.now - self._begun)
            self.closed.append(self.now)
            self._next_generation()
        self._is_due = True

    def _count(self, job):
        if job.kind == "score":
            self._open.discard(job.digest)
        else:
            self._evaluated[job.generation].discard(job.digest)
            if not self._evaluated[job.generation]:
                self.done[job.generation] = self.now

    def _beat_of(self, host, identity):
        if host.identity != identity:
            return
        seen = next(number for number in count() if number + 1 not in host.seen)
        running = [job.digest for turn in host.turns for job in turn.jobs]
        rate = sum(10 * len(turn.jobs) / turn.seconds for turn in host.turns)
        done = 1 - (host.turns[0].until - self.now) / host.turns[0].seconds if host.turns else 0
        steps = max(0, int(10 * done))  # of the episode's ten
        shown = beat(host.slots * host.width, seen, host.numbering, host.queued, running, host.unacked, rate, steps)
        self._at(self.now + host.delay, self._heard, identity, replace(shown, slots=host.slots))
        if not host.turns and self.now - host.heard > SILENT_BEATS:
            self._join(host)
        self._at(self.now + 1.0, self._beat_of, host, identity)

    def _heard(self, identity, shown):
        self.fleet.handle_heartbeat(identity, shown, self.now)
