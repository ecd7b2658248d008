"""A slot: a spawned child that scores, so that a crashed simulator costs one job and not the worker.

Spawned, never forked: a forked Zenoh session hangs. The child knows nothing of Zenoh; the parent owns it.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import queue
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic, perf_counter, sleep
from typing import Any

import numpy as np

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.messages import MAX_UPLOAD, Job, Result, TaskSpec
from dreamfleet.common.threads import pin_thread_pools

log = logging.getLogger(__name__)
FAILED_STARTS = 3
ENDING = 2.0  # seconds between a child's last word and its end
SHORT = 0.25  # seconds: after turns below it the next one already waits in the child
SMALL = 64 * 1024  # bytes of vectors that a pipe takes while its child is busy
_PR_SET_PDEATHSIG = 1

Work = tuple[Job, bytes]
"""A job and its vector's bytes."""


@dataclass(frozen=True)
class Ready:
    """A child's first word: it can score, and who draws its picture."""

    drawn_by: str


@dataclass(frozen=True)
class Done:
    """A child's word that a turn is over: a result of each of its jobs, or none where it was told to give up.

    A file that a job left comes through the pipe, never through a disk.
    """

    turn: int
    results: tuple[Result, ...]
    upload: bytes | None = None


@dataclass(frozen=True)
class SlotEvent:
    """What a slot tells its worker: ready, a turn done, or that the child is gone."""

    slot: int
    life: int
    ready: Ready | None = None
    done: Done | None = None
    gone: str | None = None


@dataclass
class Turn:
    """Jobs that a child scores together, at one temperature: one, or as many as its task's width."""

    number: int
    work: Sequence[Work]
    unwanted: set[bytes] = field(default_factory=set)

    @property
    def jobs(self) -> list[Job]:
        """Its jobs."""
        return [job for job, _ in self.work]


class Slot:
    """The parent's side of one child, which has one turn in its hands and at most one more waiting."""

    def __init__(
        self,
        number: int,
        spec: TaskSpec,
        bundle: Path,
        events: queue.SimpleQueue[tuple[str, Any]],
        memory_limit: int = 0,
    ) -> None:
        """`memory_limit` in bytes; 0: none."""
        self.number = number
        self.ready = False
        self.drawn_by = "-"
        self._spec = spec
        self._bundle = bundle
        self._events = events
        self._memory_limit = memory_limit
        self._turns: deque[Turn] = deque()
        self._short = False  # the last turn was
        self._progress = (0, 0.0)  # steps, and when they were last seen to grow
        self._life = 0
        self._failed_starts = 0
        self._start()

    @property
    def running(self) -> list[Job]:
        """Jobs of the turn in the child's hands."""
        return self._turns[0].jobs if self._turns else []

    @property
    def waiting(self) -> list[Job]:
        """Jobs that the child has not begun."""
        return [job for turn in list(self._turns)[1:] for job in turn.jobs]

    @property
    def idle(self) -> bool:
        """Ready, with nothing to do."""
        return self.ready and not self._turns

    @property
    def takes_more(self) -> bool:
        """Whether a turn may wait in the child, so that it need not wait for us between short ones."""
        return self.ready and self._short and len(self._turns) == 1

    @property
    def steps(self) -> int:
        """Environment steps of the running turn so far, over all of its jobs."""
        return int(self._steps.value) if self._turns else 0

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._process.pid or 0

    def submit(self, work: Sequence[Work]) -> None:
        """Give the child a turn; a child that is gone is noticed by its reader."""
        self._sent += 1
        turn = Turn(self._sent, work)
        self._turns.append(turn)
        if len(self._turns) == 1:
            self._begin()
        self._send(turn)

    def check(self, now: float, gap: float) -> None:
        """Kill a child whose turn makes no step; `gap` is how long this host itself stood still before `now`."""
        if not self._turns:
            return
        steps, since = self._progress
        since += gap
        stall = max(job.stall for job in self.running)
        if self.steps != steps:
            since = now
        elif now - since > stall > 0:
            self._ended_for = f"no step for {stall:g} s"
            self._process.kill()
        self._progress = (self.steps, since)

    def abandon(self, digest: bytes) -> None:
        """A job is not wanted any more; a turn without a wanted one ends at its next step, if it is not over before."""
        for turn in self._turns:
            digests = {job.digest for job in turn.jobs}
            turn.unwanted |= {digest} & digests
            if turn.unwanted == digests:
                self._abandoned[turn.number % 2] = turn.number

    def handle(self, event: SlotEvent) -> tuple[Result, ...]:
        """Take one of this slot's events; the results of its turn, if that has ended."""
        if event.life != self._life:
            return ()
        if event.ready is not None:
            self.ready, self.drawn_by = True, event.ready.drawn_by
            self._failed_starts = 0
        elif event.done is not None:
            return self._end_turn(event.done)
        elif event.gone is not None:
            return self._replace(event.gone)
        return ()

    def stop(self) -> None:
        """End the child."""
        self._life += 1
        self._process.kill()
        self._process.join()
        self._reader.join()  # before its pipe is closed, whose number the next one may have
        self._pipe.close()

    def _begin(self) -> None:
        self._progress = (0, monotonic())

    def _send(self, turn: Turn) -> None:
        try:
            self._pipe.send((turn.number, turn.work))
        except OSError:
            log.debug("slot %d is gone", self.number)

    def _end_turn(self, done: Done) -> tuple[Result, ...]:
        turn = self._turns.popleft()
        size = sum(len(vector) for _, vector in turn.work)
        self._short = size <= SMALL and bool(done.results) and sum(each.seconds for each in done.results) < SHORT
        self._begin()
        if not self._turns:
            self._replace_if_swollen()
        return done.results

    def _replace(self, why: str) -> tuple[Result, ...]:
        until = monotonic() + ENDING
        while self._process.is_alive() and monotonic() < until:  # `join` would wait for a child that is only silent
            sleep(0.005)
        if self._process.is_alive():
            self._ended_for = self._ended_for or why
            self._process.kill()
        self._process.join()
        code = self._process.exitcode or 0
        reason = self._ended_for or (f"signal {-code}" if code < 0 else why)
        self._failed_starts += not self.ready
        if self._failed_starts >= FAILED_STARTS:
            raise DreamfleetError(f"a slot cannot start: {reason}; `dreamfleet doctor` looks for the cause")
        log.warning("slot %d ended (%s); starting another", self.number, reason)
        steps = self.steps
        lost = self._turns.popleft().jobs if self._turns else []
        self._start()
        return tuple(
            Result(job.digest, None, steps // len(lost), 0.0, f"slot crashed ({reason})", None) for job in lost
        )

    def _replace_if_swollen(self) -> None:
        held = _memory_of(self.pid) if self._memory_limit else 0
        if held > self._memory_limit:
            log.warning("slot %d holds %d MiB; starting another", self.number, held >> 20)
            self.stop()
            self._start()

    def _start(self) -> None:
        """A new child; what waited in the last one's pipe goes to it."""
        self.ready = self._short = False
        self._ended_for = ""
        pin_thread_pools()
        context = get_context("spawn")
        self._life += 1
        self._sent = 0  # turns given to this child
        self._steps: Any = context.Value("Q", 0, lock=False)
        self._abandoned: Any = context.Array("Q", 2, lock=False)  # turns to give up: an even one, an odd one
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=serve_jobs,
            args=(theirs, self._steps, self._abandoned, self._spec, self._bundle, os.getpid()),
            daemon=True,
        )
        with _signals_held():
            self._process.start()
        theirs.close()
        self._reader = threading.Thread(target=self._read, args=(self._pipe, self._life), daemon=True)
        self._reader.start()
        waiting, self._turns = self._turns, deque()
        for turn in waiting:
            if wanted := [work for work in turn.work if work[0].digest not in turn.unwanted]:
                self.submit(wanted)

    def _read(self, pipe: Connection[Any, Any], life: int) -> None:
        """In a thread of its own: pass on what the child says, until it is gone."""
        why = "the child ended"
        while True:
            try:
                said = pipe.recv()
            except (EOFError, OSError):
                break
            if isinstance(said, str):
                why = said
            elif isinstance(said, Ready):
                self._events.put(("slot", SlotEvent(self.number, life, ready=said)))
            else:
                self._events.put(("slot", SlotEvent(self.number, life, done=said)))
        self._events.put(("slot", SlotEvent(self.number, life, gone=why)))


class AbandonedError(Exception):
    """The running turn is not wanted any more."""


def serve_jobs(
    pipe: Connection[Any, Any], steps: Any, abandoned: Any, spec: TaskSpec, bundle: Path, parent: int
) -> None:
    """The child: score jobs from the pipe until it closes. `steps` and `abandoned` are shared with the parent."""
    _die_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the worker decides; Ctrl-C reaches the whole group
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.common.bundle import Bundle
    from dreamfleet.worker.scoring.scorer import Scorer

    try:
        scorer = Scorer(spec, Bundle.open(bundle))
    except Exception as error:
        pipe.send(_one_line(error))
        raise SystemExit(1) from error
    pipe.send(Ready(scorer.drawn_by))

    while True:
        try:
            turn, work = pipe.recv()
        except EOFError:
            return

        def count(made: int) -> None:
            steps.value = made
            if abandoned[turn % 2] == turn:  # noqa: B023 - called within this round
                raise AbandonedError

        try:
            count(0)
            done = _do(scorer, turn, work, count)
        except AbandonedError:
            done = Done(turn, ())
        pipe.send(done)


@contextmanager
def _signals_held() -> Iterator[None]:
    """A child started here inherits the mask: Ctrl-C, which reaches the whole group, cannot end it while it imports."""
    resource_tracker.ensure_running()  # as it starts it would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _do(scorer: Any, turn: int, work: Sequence[Work], count: Callable[[int], None]) -> Done:
    """A result of each job; whatever a task raises is the jobs' error, not the slot's end."""
    started, made, upload = perf_counter(), 0, None

    def on_step(done: int) -> None:
        nonlocal made
        made = done
        count(done)

    episodes = [(job.kind, np.frombuffer(vector, dtype="<f4"), job.seeds[0]) for job, vector in work]
    try:
        if episodes[0][0] == "collect":
            _, vector, seed = episodes[0]
            score, drive = scorer.collect(vector, seed, on_step)
            scores, upload = [score], _packed(drive)
        else:
            scores = scorer.score_all(episodes, on_step, work[0][0].temperature)
    except AbandonedError:
        raise
    except Exception as error:
        each = made // len(work), (perf_counter() - started) / len(work), _one_line(error)
        return Done(turn, tuple(Result(job.digest, None, *each, None) for job, _ in work))
    spent = (perf_counter() - started) / len(work)
    sha256 = None if upload is None else hashlib.sha256(upload).digest()
    results = [
        Result(job.digest, score.fitness, score.steps, spent, None, sha256)
        for (job, _), score in zip(work, scores, strict=True)
    ]
    return Done(turn, tuple(results), upload)


def _packed(drive: Any) -> bytes:
    data: bytes = drive.packed()
    if len(data) > MAX_UPLOAD:
        raise ValueError(f"a drive of {len(drive)} steps is larger than {MAX_UPLOAD >> 20} MiB: shorten the horizon")
    return data


def _memory_of(pid: int) -> int:
    """Bytes of a process that lie in memory; 0 where that is not known."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0


def _one_line(error: Exception) -> str:
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0] if text else ''}"[:500]


def _die_with(parent: int) -> None:
    """Ask Linux to end this process with its parent; the closed pipe does so elsewhere, a job later."""
    try:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    except (OSError, AttributeError):
        return
    if os.getppid() != parent:
        raise SystemExit(1)
