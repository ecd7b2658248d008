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
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic, perf_counter
from typing import Any

import numpy as np

from common.errors import DreamfleetError
from common.messages import MAX_UPLOAD, Job, Result, TaskSpec
from common.threads import pin_thread_pools

log = logging.getLogger(__name__)
FAILED_STARTS = 3
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Ready:
    """A child's first word: it can score, and who draws its picture."""

    drawn_by: str


@dataclass(frozen=True)
class Abandoned:
    """A child's word that it gave a job up, as it was told to."""


@dataclass(frozen=True)
class Outcome:
    """A child's word on a job: its result, and the file that it left, through the pipe and never through a disk."""

    result: Result
    upload: bytes | None = None


@dataclass(frozen=True)
class SlotEvent:
    """What a slot tells its worker: ready, a result, a job given up, or that the child is gone."""

    slot: int
    life: int
    ready: Ready | None = None
    result: Result | None = None
    upload: bytes | None = None
    abandoned: bool = False
    gone: str | None = None


class Slot:
    """The parent's side of one child."""

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
        self.job: Job | None = None
        self.ready = False
        self.drawn_by = "-"
        self._spec = spec
        self._bundle = bundle
        self._events = events
        self._memory_limit = memory_limit
        self._progress = (0, 0.0)  # steps, and when they were last seen to grow
        self._life = 0
        self._failed_starts = 0
        self._start()

    @property
    def steps(self) -> int:
        """Environment steps of the running job so far."""
        return int(self._steps.value) if self.job is not None else 0

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._process.pid or 0

    def submit(self, job: Job, vector: bytes) -> None:
        """Give an idle child a job; a child that is gone is noticed by its reader."""
        self.job = job
        self._steps.value = 0
        self._progress = (0, monotonic())
        self._turn += 1
        try:
            self._pipe.send((self._turn, job, vector))
        except OSError:
            log.debug("slot %d is gone", self.number)

    def check(self, now: float, gap: float) -> None:
        """Kill a child whose job makes no step; `gap` is how long this host itself stood still before `now`."""
        if self.job is None:
            return
        steps, since = self._progress
        since += gap
        if self.steps != steps:
            since = now
        elif now - since > self.job.stall > 0:
            self._ended_for = f"no step for {self.job.stall:g} s"
            self._process.kill()
        self._progress = (self.steps, since)

    def abandon(self) -> None:
        """Let the child give up its job at its next step, without a result; it may be done before."""
        self._abandoned.value = self._turn

    def handle(self, event: SlotEvent) -> Result | None:
        """Take one of this slot's events; the result of its job, if that has ended."""
        if event.life != self._life:
            return None
        if event.ready is not None:
            self.ready, self.drawn_by = True, event.ready.drawn_by
            self._failed_starts = 0
        elif event.result is not None:
            self.job = None
            self._replace_if_swollen()
            return event.result
        elif event.abandoned:
            self.job = None
        elif event.gone is not None:
            return self._replace(event.gone)
        return None

    def stop(self) -> None:
        """End the child."""
        self._life += 1
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def _replace(self, why: str) -> Result | None:
        self._process.join()
        code = self._process.exitcode or 0
        reason = self._ended_for or (f"signal {-code}" if code < 0 else why)
        self._failed_starts += not self.ready
        if self._failed_starts >= FAILED_STARTS:
            raise DreamfleetError(f"a slot cannot start: {reason}; `dreamfleet doctor` looks for the cause")
        log.warning("slot %d ended (%s); starting another", self.number, reason)
        job, self.job, self.ready = self.job, None, False
        steps = int(self._steps.value)
        self._start()
        if job is None:
            return None
        return Result(job.digest, None, steps, 0.0, f"slot crashed ({reason})", None)

    def _replace_if_swollen(self) -> None:
        held = _memory_of(self.pid) if self._memory_limit else 0
        if held > self._memory_limit:
            log.warning("slot %d holds %d MiB; starting another", self.number, held >> 20)
            self.stop()
            self.ready = False
            self._start()

    def _start(self) -> None:
        self._ended_for = ""
        pin_thread_pools()
        context = get_context("spawn")
        self._life += 1
        self._turn = 0  # of this child: its jobs, counted
        self._steps: Any = context.Value("Q", 0, lock=False)
        self._abandoned: Any = context.Value("Q", 0, lock=False)  # the turn to give up
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=serve_jobs,
            args=(theirs, self._steps, self._abandoned, self._spec, self._bundle, os.getpid()),
            daemon=True,
        )
        with _signals_held():
            self._process.start()
        theirs.close()
        threading.Thread(target=self._read, args=(self._pipe, self._life), daemon=True).start()

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
            elif isinstance(said, Abandoned):
                self._events.put(("slot", SlotEvent(self.number, life, abandoned=True)))
            else:
                event = SlotEvent(self.number, life, result=said.result, upload=said.upload)
                self._events.put(("slot", event))
        self._events.put(("slot", SlotEvent(self.number, life, gone=why)))


class AbandonedError(Exception):
    """The running job is not wanted any more."""


def serve_jobs(
    pipe: Connection[Any, Any], steps: Any, abandoned: Any, spec: TaskSpec, bundle: Path, parent: int
) -> None:
    """The child: score jobs from the pipe until it closes. `steps` and `abandoned` are shared with the parent."""
    _die_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the worker decides; Ctrl-C reaches the whole group
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from common.bundle import Bundle
    from worker.scoring import Scorer

    try:
        scorer = Scorer(spec, Bundle.open(bundle))
    except Exception as error:
        pipe.send(_one_line(error))
        raise SystemExit(1) from error
    pipe.send(Ready(scorer.drawn_by))

    turn = 0

    def count(done: int) -> None:
        steps.value = done
        if abandoned.value == turn:
            raise AbandonedError

    while True:
        try:
            turn, job, vector = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send(_score(scorer, job, vector, count))
        except AbandonedError:
            pipe.send(Abandoned())


@contextmanager
def _signals_held() -> Iterator[None]:
    """A child started here inherits the mask: Ctrl-C, which reaches the whole group, cannot end it while it imports."""
    resource_tracker.ensure_running()  # as it starts it would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _score(scorer: Any, job: Job, vector: bytes, count: Any) -> Outcome:
    started = perf_counter()
    made = 0

    def on_step(done: int) -> None:
        nonlocal made
        made = done
        count(done)

    parameters, upload = np.frombuffer(vector, dtype="<f4"), None
    try:
        if job.kind == "collect":
            score, drive = scorer.collect(parameters, job.seeds[0], on_step)
            upload = _packed(drive)
        else:
            score = scorer.score(job.kind, parameters, job.seeds[0], on_step)
    except AbandonedError:
        raise
    except Exception as error:  # whatever a task raises is this job's error, not the slot's end
        return Outcome(Result(job.digest, None, made, perf_counter() - started, _one_line(error), None))
    sha256 = None if upload is None else hashlib.sha256(upload).digest()
    return Outcome(
        Result(job.digest, score.fitness, score.steps, perf_counter() - started, None, sha256),
        upload,
    )


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
