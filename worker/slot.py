"""A slot: a spawned child that scores, so that a crashed simulator costs one job and not the worker.

Spawned, never forked: a forked Zenoh session hangs. The child knows nothing of Zenoh; the parent owns it.
"""

from __future__ import annotations

import ctypes
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
from time import perf_counter
from typing import Any

import numpy as np

from common.errors import DreamfleetError
from common.messages import Job, Result, TaskSpec
from common.threads import pin_thread_pools

log = logging.getLogger(__name__)
FAILED_STARTS = 3
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Ready:
    """A child's first word: it can score, and who draws its picture."""

    drawn_by: str


@dataclass(frozen=True)
class SlotEvent:
    """What a slot tells its worker: ready, a result, or (with neither) that the child is gone."""

    slot: int
    life: int
    ready: Ready | None = None
    result: Result | None = None
    gone: str | None = None


class Slot:
    """The parent's side of one child."""

    def __init__(self, number: int, spec: TaskSpec, bundle: Path, events: queue.SimpleQueue[tuple[str, Any]]) -> None:
        self.number = number
        self.job: Job | None = None
        self.ready = False
        self.drawn_by = "-"
        self._spec = spec
        self._bundle = bundle
        self._events = events
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
        try:
            self._pipe.send((job, vector))
        except OSError:
            log.debug("slot %d is gone", self.number)

    def handle(self, event: SlotEvent) -> Result | None:
        """Take one of this slot's events; the result of its job, if that has ended."""
        if event.life != self._life:
            return None
        if event.ready is not None:
            self.ready, self.drawn_by = True, event.ready.drawn_by
            self._failed_starts = 0
        elif event.result is not None:
            self.job = None
            return event.result
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
        reason = f"signal {-code}" if code < 0 else why
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

    def _start(self) -> None:
        pin_thread_pools()
        context = get_context("spawn")
        self._life += 1
        self._steps: Any = context.Value("Q", 0, lock=False)
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=serve_jobs, args=(theirs, self._steps, self._spec, self._bundle, os.getpid()), daemon=True
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
            else:
                self._events.put(("slot", SlotEvent(self.number, life, result=said)))
        self._events.put(("slot", SlotEvent(self.number, life, gone=why)))


def serve_jobs(pipe: Connection[Any, Any], steps: Any, spec: TaskSpec, bundle: Path, parent: int) -> None:
    """The child: score jobs from the pipe until it closes."""
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

    def count(done: int) -> None:
        steps.value = done

    while True:
        try:
            job, vector = pipe.recv()
        except EOFError:
            return
        pipe.send(_score(scorer, job, vector, count))


@contextmanager
def _signals_held() -> Iterator[None]:
    """A child started here inherits the mask: Ctrl-C, which reaches the whole group, cannot end it while it imports."""
    resource_tracker.ensure_running()  # as it starts it would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _score(scorer: Any, job: Job, vector: bytes, count: Any) -> Result:
    started = perf_counter()
    count(0)
    made = 0

    def on_step(done: int) -> None:
        nonlocal made
        made = done
        count(done)

    try:
        score = scorer.score(job.kind, np.frombuffer(vector, dtype="<f4"), job.seeds[0], on_step)
    except Exception as error:  # whatever a task raises is this job's error, not the slot's end
        return Result(job.digest, None, made, perf_counter() - started, _one_line(error), None)
    return Result(job.digest, score.fitness, score.steps, perf_counter() - started, None, None)


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
