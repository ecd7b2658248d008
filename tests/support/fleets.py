"""A simulated fleet: the real `Fleet`, and hosts with simulated time and network."""

import heapq
from dataclasses import dataclass, field
from itertools import count

import numpy as np

from dreamfleet.common.protocol.messages import TAG_BYTES, Heartbeat, Result, RunningJob
from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.jobs.work import make_work, vector_bytes
from tests.support.samples import HEAD, SPEC

TICK = 0.05
JOB_BYTES = 300
SILENT_BEATS = 5  # after which an idle worker sends hello again


@dataclass
class Host:
    """A worker with one slot; a turn takes `turn` seconds, and `row` more for each job."""

    name: str
    width: int = 1
    turn: float = 0.0
    row: float = 0.05
    delay: float = 0.0005  # seconds each way
    bandwidth: float = 1e8  # bytes a second, to the host
    lives: float = 0.0  # seconds until it is killed and, a second later, restarted; 0: never
    identity: str = ""
    seen: set[int] = field(default_factory=set)
    queued: dict[bytes, None] = field(default_factory=dict)
    running: list[bytes] = field(default_factory=list)
    unacked: dict[bytes, None] = field(default_factory=dict)
    heard: float = 0.0
    busy_until: float = 0.0  # its network link
    joins: int = 0
    until: float = 0.0  # the end of its turn


class Played:
    """A simulated run; `seconds` lists how long each generation took."""

    def __init__(self, *hosts, population=16, episodes=4, size=64, beat=1.0):
        self.fleet = Fleet(beat)
        self.hosts = hosts
        self.seconds, self.made, self.resent_bytes, self.sent_bytes = [], 0, 0, 0
        self._beat, self._population, self._episodes, self._size = beat, population, episodes, size
        self.now, self._order, self._events, self._number = 0.0, count(), [], -1
        self._open, self._known = set(), set()
        self._next_generation()
        for host in hosts:
            self._at(0.0, self._start, host)

    def play(self, generations, within=10_000.0):
        """Run until so many generations are closed; return the seconds of each."""
        self._at(self.now, self._tick)
        while len(self.seconds) < generations:
            self.now, _, action, arguments = heapq.heappop(self._events)
            assert self.now < within, f"{len(self.seconds)} generations in {within} s"
            action(*arguments)
        return self.seconds

    def _at(self, when, action, *arguments):
        heapq.heappush(self._events, (when, next(self._order), action, arguments))

    def _next_generation(self):
        self._number += 1
        self._begun = self.now
        self.fleet.jobs.begin_generation(self._number)
        for candidate in range(self._population):
            vector = vector_bytes(np.arange(float(self._size)) + candidate + self._number * 1000)
            work = make_work(SPEC, "score", self._number, candidate, vector, range(1000, 1000 + self._episodes))
            self._open |= {each.job.digest for each in work}
            self.fleet.jobs.offer(work)

    def _tick(self):
        self._dispatch()
        self._at(self.now + TICK, self._tick)

    def _dispatch(self):
        self.fleet.tick(self.now)
        self._send(self.fleet.dispatch(self.now))
        self.fleet.notes.clear()

    def _send(self, sends):
        for send in sends:
            host = next((host for host in self.hosts if host.identity == send.identity), None)
            if host is None:
                continue
            size = 200 + sum(len(part.data) for part in send.vectors) + JOB_BYTES * len(send.work)
            size += 40 * (len(send.cancels) + len(send.verdicts))
            self.sent_bytes += size
            host.busy_until = max(host.busy_until, self.now) + size / host.bandwidth
            self._at(host.busy_until + host.delay, self._arrive, host, send)

    def _start(self, host):
        host.identity = f"{host.name}/{next(self._order):08x}"
        host.queued, host.running, host.unacked = {}, [], {}
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
        host.joins += 1
        host.numbering = self.fleet.add_worker(host.identity, 1, "f", self.now)

    def _arrive(self, host, send):
        if host.identity != send.identity:
            return
        host.heard = self.now
        if send.number in host.seen or not send.number:
            return
        host.seen.add(send.number)
        for digest in send.cancels:
            host.queued.pop(digest, None)
            host.running = [each for each in host.running if each != digest] if host.width == 1 else host.running
        for verdict in send.verdicts:
            host.unacked.pop(verdict.digest, None)
        host.queued |= {work.job.digest: None for work in send.work}
        self._fill(host)

    def _fill(self, host):
        if host.running or not host.queued:
            return
        host.running = list(host.queued)[: host.width]
        for digest in host.running:
            del host.queued[digest]
        seconds = host.turn + host.row * len(host.running)
        host.until = self.now + seconds
        self._at(self.now + seconds, self._finish, host, host.identity, host.running, seconds)

    def _finish(self, host, identity, turn, seconds):
        if host.identity != identity or host.running != turn:
            if host.identity == identity and not host.running:
                self._fill(host)
            return
        host.heard = self.now
        each = seconds / len(turn)
        host.running = []
        host.unacked |= dict.fromkeys(turn)
        self.made += len(turn)
        results = [Result(digest, 1.0, 10, each, None, None) for digest in turn]
        self._at(self.now + host.delay, self._receive, identity, results)
        self._fill(host)

    def _receive(self, identity, results):
        for result in results:
            verdict, _ = self.fleet.handle_result(identity, result, self.now)
            if verdict == "accepted":
                self._open.discard(result.digest)
        while not self._open:
            self.seconds.append(self.now - self._begun)
            self._next_generation()
        self._dispatch()

    def _beat_of(self, host, identity):
        if host.identity != identity:
            return
        seen = 0
        while seen + 1 in host.seen:
            seen += 1
        beat = Heartbeat(
            **HEAD, nonce="n", numbering=host.numbering, seen=seen,
            capacity=host.width, slots=1, load=0.0, drawn_by="-",
            steps_per_second=10 * len(host.running) / (host.turn + host.row * max(1, len(host.running))),
            queued=tuple(digest[:TAG_BYTES] for digest in host.queued),
            running=tuple(RunningJob(digest[:TAG_BYTES], self._steps(host)) for digest in host.running),
            unacked=tuple(digest[:TAG_BYTES] for digest in host.unacked),
        )  # fmt: skip
        self._at(self.now + host.delay, self._heard, identity, beat)
        if not host.running and self.now - host.heard > SILENT_BEATS * self._beat:
            self._join(host)
        self._at(self.now + self._beat, self._beat_of, host, identity)

    def _steps(self, host):
        """Steps made of the episode's ten."""
        left = host.until - self.now
        return max(0, int(10 * (1 - left / (host.turn + host.row * len(host.running)))))

    def _heard(self, identity, beat):
        self.fleet.handle_heartbeat(identity, beat, self.now)
