"""A slot: one scoring child after another, so that a crashed simulator costs one job and not the worker."""

from __future__ import annotations

import logging
import queue
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.messages import Job, Result, TaskSpec
from dreamfleet.worker.service.child import Ready
from dreamfleet.worker.service.process import ChildProcess, Word
from dreamfleet.worker.service.turn import Done, Failure, Turn, Work

log = logging.getLogger(__name__)
FAILED_STARTS = 3
START_LIMIT = 120.0  # seconds that a child may take to load task and world model; doubled with each that took longer
SHORT = 0.25  # seconds: after turns below it the next one already waits in the child
SMALL = 64 * 1024  # bytes of vectors that a pipe takes while its child is busy


@dataclass(frozen=True)
class SlotEvent:
    """What a slot tells its worker: a word of the child of that life, or that it is gone."""

    slot: int
    life: int
    word: Word

    @property
    def failure(self) -> Failure | None:
        """What the child raised: as it started, or in the turn that is over."""
        if isinstance(self.word, Done):
            return self.word.failure
        return self.word if isinstance(self.word, Failure) else None

    @property
    def upload(self) -> bytes | None:
        """The file that the turn left."""
        return self.word.upload if isinstance(self.word, Done) else None


class Slot:
    """The parent's side of one child, which has one turn in its hands and at most one more waiting."""

    def __init__(
        self,
        number: int,
        spec: TaskSpec,
        bundle: Path | None,
        events: queue.SimpleQueue[tuple[str, Any]],
        announced: tuple[str, ...],
        memory_limit: int = 0,
    ) -> None:
        """`announced` are the tasks that its worker lets itself be asked for; `memory_limit` in bytes; 0: none."""
        self.number = number
        self.ready = False
        self.drawn_by = "-"
        self._spec = spec
        self._bundle = bundle
        self._announced = announced
        self._events = events
        self._memory_limit = memory_limit
        self._turns: deque[Turn] = deque()
        self._short = False  # the last turn was
        self._progress = (0, 0.0)  # steps, and when they were last seen to grow; while it starts, when that began
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
        return self._child.steps if self._turns else 0

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._child.pid

    def submit(self, work: Sequence[Work]) -> None:
        """Give the child a turn."""
        self._sent += 1
        turn = Turn(self._sent, work)
        self._turns.append(turn)
        if len(self._turns) == 1:
            self._watch_anew()
        self._child.send(turn.number, turn.work)

    def check(self, now: float, gap: float) -> None:
        """Kill a child that hangs in a turn or as it starts; `gap` is how long this host itself stood still."""
        steps, since = self._progress
        since += gap
        if not self.ready:
            limit = START_LIMIT * 2**self._failed_starts
            self._kill_after(limit, now - since, f"no word for {limit:g} s as it started")
        elif self._turns:
            if self.steps != steps:
                since = now
            limit = max(job.stall for job in self.running)
            self._kill_after(limit, now - since, f"no step for {limit:g} s")
        self._progress = (self.steps, since)

    def abandon(self, digest: bytes) -> None:
        """A job is not wanted any more; a turn without a wanted one ends at its next step, if it is not over before."""
        for turn in self._turns:
            digests = {job.digest for job in turn.jobs}
            turn.unwanted |= {digest} & digests
            if turn.unwanted == digests:
                self._child.give_up(turn.number)

    def handle(self, event: SlotEvent) -> tuple[Result, ...]:
        """Take one of this slot's events; the results of its turn, if that has ended."""
        if event.life != self._life:
            return ()
        if isinstance(event.word, Ready):
            self.ready, self.drawn_by = True, event.word.drawn_by
            self._failed_starts = 0
            self._watch_anew()
        elif isinstance(event.word, Done):
            return self._end_turn(event.word)
        elif isinstance(event.word, Failure):
            self._last_word = event.word.text
        else:
            return self._replace()
        return ()

    def stop(self) -> None:
        """End the child."""
        self._life += 1
        self._child.close()

    def _watch_anew(self) -> None:
        self._progress = (0, monotonic())

    def _kill_after(self, limit: float, quiet: float, why: str) -> None:
        """Kill a child that has been quiet for longer than `limit` seconds; 0: never."""
        if quiet > limit > 0:
            self._ended_for = why
            self._child.kill()

    def _end_turn(self, done: Done) -> tuple[Result, ...]:
        turn = self._turns.popleft()
        self._short = turn.size <= SMALL and bool(done.results) and sum(each.seconds for each in done.results) < SHORT
        self._watch_anew()
        if not self._turns and 0 < self._memory_limit < (held := self._child.memory):
            log.warning("slot %d holds %d MiB; starting another", self.number, held >> 20)
            self.stop()
            self._start()
        return done.results

    def _replace(self) -> tuple[Result, ...]:
        """Another child in the place of one that is gone; errors for the jobs that it had in its hands."""
        if not self._child.wait():
            self._ended_for = self._ended_for or self._last_word
        steps = self.steps
        ended_by = self._child.close()
        reason = self._ended_for or ended_by or self._last_word
        self._failed_starts += not self.ready
        if self._failed_starts >= FAILED_STARTS:
            raise DreamfleetError(f"a slot cannot start: {reason}; `dreamfleet doctor` looks for the cause")
        lost = self._turns.popleft().jobs if self.ready and self._turns else []  # one that starts has begun nothing
        log.warning("slot %d ended (%s)%s; starting another", self.number, reason, _among(lost))
        self._start()
        return tuple(
            Result(job.digest, None, steps // len(lost), 0.0, f"slot crashed ({reason})", None) for job in lost
        )

    def _start(self) -> None:
        """A new child; what waited for the last one goes to it."""
        self.ready = self._short = False
        self._ended_for, self._last_word = "", "the child ended"
        self._sent = 0  # turns given to this child
        self._life += 1
        number, life, events = self.number, self._life, self._events
        self._child = ChildProcess(
            self._spec,
            self._bundle,
            self._announced,
            lambda word: events.put(("slot", SlotEvent(number, life, word))),
        )
        self._watch_anew()
        waiting, self._turns = self._turns, deque()
        for turn in waiting:
            if wanted := [work for work in turn.work if work[0].digest not in turn.unwanted]:
                self.submit(wanted)


def _among(jobs: list[Job]) -> str:
    """Which job a crash was in."""
    if not jobs:
        return ""
    first, more = jobs[0], f" and {len(jobs) - 1} more" if len(jobs) > 1 else ""
    return f" in generation {first.generation}, candidate {first.candidate}, seed {first.seeds[0]}{more}"
