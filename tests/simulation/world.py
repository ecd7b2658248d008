"""A play: a coordinator, workers, what lies between them, and the faults of one schedule, by a virtual clock."""

from __future__ import annotations

import heapq
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import count
from typing import Any

import msgspec

from dreamfleet.common.protocol.messages import HelloRequest, Job, JobBatch
from dreamfleet.coordinator.dispatch.failures import LONGEST_PAUSE
from dreamfleet.coordinator.dispatch.packing import SentBatch
from dreamfleet.coordinator.run.run import BY_HAND
from tests.simulation import books
from tests.simulation.coordinator import COMMITTED, LINGER, OPENED, TICK, Coordinator, simulated_surroundings
from tests.simulation.disk import Disk
from tests.simulation.network import LATENCY, Link
from tests.simulation.schedule import Schedule, Shape
from tests.simulation.truth import HopelessError, settings_of, truth_of
from tests.simulation.violation import Violation
from tests.simulation.witness import Confirmed, Witness
from tests.simulation.worker import Scored, Token, Welcome, Worker

PATIENCE = 2 * LONGEST_PAUSE + 60  # virtual seconds: a job that failed often is tried again after such a pause
OPERATOR = 0.5  # virtual seconds after which somebody resumes a run that failing jobs have paused
AUDIT = 4  # turns of the coordinator between two looks into the books
MAX_EVENTS = 200_000  # of one play: more is a loop


@dataclass
class Outcome:
    """What a play came to."""

    schedule: Schedule
    violation: Violation | None
    now: float  # virtual seconds
    events: int
    happened: Counter[str]  # faults that found something to disturb
    scored: int  # environment steps that slots made
    counted: int  # of those, in results that count
    trace: str = ""  # where the product raised, if it did


@dataclass
class Pending:
    """A coordinator's end to come: so many steps of its turns from now, or from a generation's opening."""

    steps: int
    away: float
    opening: bool


@dataclass
class World:
    """`play` runs it to its end."""

    schedule: Schedule
    now: float = 0.0
    happened: Counter[str] = field(default_factory=Counter)
    coordinator: Coordinator | None = None
    coordinator_stopped: bool = False
    kill: Pending | None = None
    patience: float = PATIENCE
    lies: dict[int, Callable[[Job, float], float]] = field(default_factory=dict)  # by host
    classes: dict[int, str] = field(default_factory=dict)  # by host
    seats: dict[int, int] = field(default_factory=dict)  # by host: whose join file it has, in a secured fleet
    trusted: frozenset[int] = frozenset()  # hosts that are the coordinator's own
    bars: dict[int, float] = field(default_factory=dict)  # when the operator bars a host

    def __post_init__(self) -> None:
        shape = self.shape = self.schedule.shape
        self.disk, self.witness, self.scored = Disk(), Witness(shape), Scored()
        self.links = [Link() for _ in range(shape.workers)]
        self.workers: list[Worker | None] = [None] * shape.workers
        self.events = 0
        self._spec = settings_of(shape).task
        self._heap: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        self._order = count()
        self._sendings, self._turned_at = books.Sendings(), 0.0
        self._sights = [0.0] * shape.workers  # since when each worker sees what it sees
        self._lives, self._names = count(1), count(1)
        self._inbox: list[tuple[str, Any]] = []  # of whichever coordinator lives
        self._wakes: dict[int, float] = {}  # by host; the coordinator's is -1
        self._turns = 0
        self.is_silent = False
        self._operator_called = False
        self._done = False
        self._calm_at = max((fault.at + fault.seconds + 5.0 for fault in self.schedule.faults), default=0.0)

    def play(self) -> None:
        """To the end of the run; `Violation` if a rule is broken on the way."""
        from tests.simulation.faults import strike

        self.start_coordinator()
        for host in range(self.shape.workers):
            self.later(0.01 * host, self.start_worker, host)
        for fault in self.schedule.faults:
            self.later(fault.at, strike, self, fault)
        for host, at in self.bars.items():
            self.later(at, self.bar, host)
        self.later(self._calm_at, setattr, self, "kill", None)
        while not self._done:
            self.now, _, action, arguments = heapq.heappop(self._heap)
            self.events += 1
            if self.now > self._calm_at + self.patience or self.events > MAX_EVENTS:
                self._give_up()
            action(*arguments)
        self.disk.crash()
        self.witness.finished(self.disk)
        if self.shape.confirm_episodes and self.shape.ends and self.schedule.faults:
            self.witness.confirmed(self.confirmed, _confirmed_in_calm(self.shape))
        self._check_waste()

    def later(self, seconds: float, action: Callable[..., None], *arguments: Any) -> None:
        """Do something then."""
        heapq.heappush(self._heap, (self.now + seconds, next(self._order), action, arguments))

    # The coordinator's side.

    def start_coordinator(self) -> None:
        """A life from what is on the disk, unless one is there."""
        if self.coordinator is not None or self._done:
            return
        self.disk.crash()
        life = self.coordinator = Coordinator(
            self.disk, self.witness, self.shape, next(self._lives), self.now, is_secured=bool(self.seats)
        )
        self.coordinator_stopped = False
        self._operator_called = False
        self._sendings = books.Sendings()
        self._inbox.clear()
        self._pause_finally()
        if life.over:
            self._done = True
            return
        for host in range(self.shape.workers):
            self.later(0.03 + 0.01 * host, self.look, host)
        self.wake_coordinator(TICK)

    def end_coordinator(self, away: float) -> None:
        """It is gone, with all that it did not commit."""
        self.coordinator = self.kill = None
        self._wakes.pop(-1, None)
        for host in range(self.shape.workers):
            self.later(LATENCY, self.look, host)
        self.later(away, self.start_coordinator)

    def wake_coordinator(self, seconds: float) -> None:
        """It turns then, or earlier."""
        at = self.now + seconds
        if at < self._wakes.get(-1, at + 1):
            self._wakes[-1] = at
            self.later(seconds, self._turn_coordinator, at)

    def _turn_coordinator(self, at: float) -> None:
        life = self.coordinator
        if life is None or self._wakes.get(-1) != at or self.coordinator_stopped:
            return
        del self._wakes[-1]
        self._hear_all(life)
        self._sendings.pass_by(min(self.now - self._turned_at, TICK))
        self._turned_at = self.now
        for step in life.turn(self.now):
            if self._dies(step):
                self.end_coordinator(self.kill.away if self.kill else 1.0)
                return
            if step == OPENED:
                books.check_opening(life.fleet, life.run)
            elif isinstance(step, SentBatch):
                books.check_credit(life.fleet, step)
                self._sendings.sent(life.fleet, step)
                self._send_down(life, step)
        self._after_turn(life)

    def _hear_all(self, life: Coordinator) -> None:
        inbox, self._inbox = self._inbox, []
        for worker, message in inbox:
            life.hear(worker, message, self.now)

    def _dies(self, step: SentBatch | str | None) -> bool:
        kill = self.kill
        if kill is None:
            return False
        if kill.opening:
            kill.opening = step != OPENED
            return False
        kill.steps -= 1
        return kill.steps < 0 or (step == COMMITTED and kill.steps == 0)

    def _after_turn(self, life: Coordinator) -> None:
        self._turns += 1
        if self._turns % AUDIT == 0:
            books.check_coordinator(life.fleet)
            self._sendings.check(life.fleet)
            self._check_workers()
        if life.run.state.ended is not None:
            books.check_end(life.fleet, life.run)
            self._done = True
            return
        self._pause_finally()
        if life.over:
            self.end_coordinator(1.0)
            return
        if life.run.state.paused and not self.is_silent and not self._operator_called:
            self._operator_called = True
            self.later(OPERATOR, self.resume, life)
        if self.is_silent and self.now >= self._calm_at and self._at_rest(life):
            self._done = True
        self.wake_coordinator(TICK)

    def _check_workers(self) -> None:
        for host, worker in enumerate(self.workers):
            if worker is not None:
                books.check_sight(worker, self.links[host].sees, self._sights[host], self.now)

    def resume(self, life: Coordinator) -> None:
        """Somebody says `dreamfleet resume`."""
        if life is self.coordinator and not self.is_silent:
            self._operator_called = life.draining = False
            life.run.resume()

    def bar(self, host: int, is_barred: bool = True) -> None:
        """Somebody says `dreamfleet bar HOST`, or adds `--no-longer`, again until it is done."""
        name = self.name_of(host)
        if self.coordinator is not None and not self.coordinator_stopped:
            self.coordinator.run.bar(name, is_barred=is_barred)
            self.wake_coordinator(LINGER)
        if (name in self.disk.barred) != is_barred:
            self.later(OPERATOR, self.bar, host, is_barred)

    def _pause_finally(self) -> None:
        """A run that shall fall silent is paused once its last generation is closed."""
        life = self.coordinator
        if life is not None and not self.shape.ends and len(life.run.history) >= self.shape.generations:
            self.is_silent = True
            life.draining = False
            if life.run.state.paused is None:
                life.run.pause(BY_HAND)

    def _at_rest(self, life: Coordinator) -> bool:
        quiet = all(worker is not None and not worker.undelivered for worker in self.workers)
        return quiet and books.at_rest(life.fleet, life.run)

    # The workers' side.

    def start_worker(self, host: int) -> None:
        """A process, under the name of the one before it."""
        if self.workers[host] is not None:
            return
        identity = f"{self.name_of(host)}/{next(self._names):08x}"

        def send(message: Any) -> None:
            self._send_up(host, identity, message)

        worker = Worker(identity, self.shape, self._spec, self.now, send, self.scored)
        worker.lie, worker.is_trusted = self.lies.get(host, worker.lie), host in self.trusted
        worker.host_class = self.classes.get(host, worker.host_class)
        self.workers[host] = worker
        self.links[host].sees = None
        self._turn_worker(host, worker)

    def end_worker(self, host: int, noticed: float, away: float) -> None:
        """A process is gone; its token vanishes so many seconds later, and another one is started."""
        worker = self.workers[host]
        if worker is None:
            return
        for turn in worker.turns:
            if turn is not None:
                self.scored.steps += turn.steps(self.now) * len(turn.work)
        self.workers[host] = None
        self._wakes.pop(host, None)
        self.later(noticed, self.send_to_coordinator, worker.identity, "gone")
        self.later(away, self.start_worker, host)

    def look(self, host: int, *, blink: bool = False) -> None:
        """Notify a worker of the coordinators that it sees, if they changed or after a `blink`."""
        worker, link, life = self.workers[host], self.links[host], self.coordinator
        if worker is None or worker.nonce is None:
            return
        sees = life.nonce if life is not None and not link.cuts else None
        if sees == link.sees and not blink:
            return
        for nonce, there in ((link.sees, False), (sees, True)):
            if nonce is not None:
                worker.inbox.append(Token(nonce, there))
        link.sees, self._sights[host] = sees, self.now
        self.wake_worker(host, worker, self.now)

    def lose_sight(self, host: int) -> None:
        """The worker's side notices that its connection has ended."""
        worker, link = self.workers[host], self.links[host]
        if worker is not None and worker.nonce is not None and link.sees is not None:
            worker.inbox.append(Token(link.sees, there=False))
            link.sees = None
            self.wake_worker(host, worker, self.now)
            self.later(0.05, self.look, host)  # a short cut may be over by then

    def wake_worker(self, host: int, worker: Worker, at: float) -> None:
        """It turns then, or earlier."""
        if worker.stopped or at >= self._wakes.get(host, at + 1):
            return
        self._wakes[host] = at
        self.later(at - self.now, self._timed_turn, host, worker, at)

    def _timed_turn(self, host: int, worker: Worker, at: float) -> None:
        if self._wakes.get(host) == at and self.workers[host] is worker and not worker.stopped:
            del self._wakes[host]
            self._turn_worker(host, worker)

    def _turn_worker(self, host: int, worker: Worker) -> None:
        worker.turn(self.now)
        books.check_worker(worker, self.now)
        if worker.left:
            self.end_worker(host, LATENCY, 1.0)
            return
        self.wake_worker(host, worker, max(worker.wakes_at(self.now), self.now + 0.001))

    # Between them.

    def name_of(self, host: int) -> str:
        """The name of a host; in a secured fleet it ends in its seat."""
        return f"w{host}.{self.seats[host]}" if self.seats else f"w{host}"

    def send_to_coordinator(self, identity: str, message: Any) -> None:
        """A message has arrived at whichever life is there."""
        if self.coordinator is not None:
            self._inbox.append((identity, message))
            if not self.coordinator_stopped:
                self.wake_coordinator(LINGER)

    def _send_up(self, host: int, identity: str, message: Any) -> None:
        for delay in self.links[host].fates("up", self.now):
            if isinstance(message, tuple):
                self.later(delay, self._hello, host, *message)
            else:
                self.later(delay, self.send_to_coordinator, identity, message)

    def _hello(self, host: int, request: HelloRequest, question: int) -> None:
        life = self.coordinator
        if life is None:
            return
        if self.coordinator_stopped:  # it lies in the queue until it goes on
            self.later(0.1, self._hello, host, request, question)
            return
        self._hear_all(life)
        if (numbering := life.welcome(request, self.now)) is not None:
            self._transmit_down(host, request.worker, Welcome(life.nonce, question, numbering))
        self.wake_coordinator(LINGER)

    def _send_down(self, life: Coordinator, send: SentBatch) -> None:
        host = int(send.identity.partition("/")[0].partition(".")[0][1:])
        batch = life.batch(send)
        self.witness.promised(self.disk, batch)
        link = self.links[host]
        if link.garbled and batch.jobs:
            link.garbled = False
            first, *others = batch.jobs
            other = msgspec.structs.replace(first, seeds=(first.seeds[0] + 1,))
            batch = msgspec.structs.replace(batch, jobs=(other, *others))
        self._transmit_down(host, send.identity, batch)

    def _transmit_down(self, host: int, identity: str, message: JobBatch | Welcome) -> None:
        for delay in self.links[host].fates("down", self.now):
            self.later(delay, self._arrive, host, identity, message)

    def _arrive(self, host: int, identity: str, message: JobBatch | Welcome) -> None:
        worker = self.workers[host]
        if worker is None or worker.identity != identity:
            return
        if worker.stopped:
            self.later(0.1, self._arrive, host, identity, message)
        elif isinstance(message, JobBatch):
            worker.inbox.append(message)
            if not worker.asking:
                self.wake_worker(host, worker, self.now)
        else:
            worker.answer(message, self.now)
            self.look(host)
            self.wake_worker(host, worker, self.now)

    # The end.

    def _give_up(self) -> None:
        life = self.coordinator
        if life is not None and self.is_silent:
            books.check_rest(life.fleet, life.run)
            held = {worker.identity: worker.undelivered for worker in self.workers if worker is not None}
            raise Violation("memory", f"workers of a paused run hold {held}")
        run = None if life is None else life.run
        state = "no coordinator" if run is None else f"generation {run.generation.number} is open, {run.state!r}"
        since = f"{self.now - self._calm_at:.0f} s after the last fault, {self.events} events"
        raise Violation("liveness", f"{state}, {since}")

    def _check_waste(self) -> None:
        """What is scored beyond what counts was lost by a fault, one worker's hands at most each."""
        if self.happened["bar"]:
            return  # all that a host ever brought and checked is scored again
        vain = self.scored.steps / 100 - self.counted_jobs - self.count_checks("checker != ''") - self.scored.failures
        hands, faults = 3 * self.shape.slots * min(self.shape.width, self.shape.most_jobs), len(self.schedule.faults)
        if vain > hands * (2 + faults):
            raise Violation("waste", f"{vain:.0f} jobs were scored in vain under {faults} faults")

    @property
    def counted_jobs(self) -> int:
        """Results on the disk."""
        return int(self.disk.read("SELECT count(*) FROM result")[0][0])

    def count_checks(self, which: str = "true") -> int:
        """Results that were checked, or drawn and not checked, of which that is so."""
        query = f"SELECT count(DISTINCT digest) FROM verification WHERE stands AND {which}"
        return int(self.disk.read(query)[0][0])

    @property
    def confirmed(self) -> Confirmed:
        """What the run's end comes to."""
        facts = self.disk.read("SELECT value FROM run WHERE key = 'confirmed'")
        return facts[0][0] if facts else None, {digest for (digest,) in self.disk.read("SELECT digest FROM result")}


_playing: list[World] = []


@lru_cache(512)
def _confirmed_in_calm(shape: Shape) -> Confirmed:
    """What a run of this shape comes to when nobody disturbs it."""
    disturbed, calm = _playing[0], World(Schedule(shape, ()))
    _playing[0] = calm
    calm.play()
    _playing[0] = disturbed
    return calm.confirmed


def play(schedule: Schedule) -> Outcome:
    """Play one schedule; what the product raises is a broken rule too.

    One in which a generation can never be scored is played without failing episodes.
    """
    try:
        truth_of(schedule.shape)
    except HopelessError:
        schedule = replace(schedule, shape=replace(schedule.shape, failing=0.0))
    world = World(schedule)
    _playing[:] = [world]
    violation, trace = None, ""
    try:
        with simulated_surroundings(lambda: _playing[0].disk):
            world.play()
    except Violation as found:
        violation = found
    except Exception as error:
        violation = Violation("raised", f"{type(error).__name__}: {error}")
        trace = traceback.format_exc()
    counted = 100 * world.counted_jobs
    return Outcome(schedule, violation, world.now, world.events, world.happened, world.scored.steps, counted, trace)
