"""A slot: one scoring child after another, so that a crashed simulator costs one job and not the worker."""

from __future__ import annotations

import logging
import queue
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from dreamfleet.common.errors import BundleError, DreamfleetError
from dreamfleet.common.messages import Job, Result, TaskSpec
from dreamfleet.common.printable import shortened
from dreamfleet.worker.service.child import Ready
from dreamfleet.worker.service.glimpses import Seen
from dreamfleet.worker.service.process import ChildProcess, Word
from dreamfleet.worker.service.turn import Done, Failure, Turn, Work

log = logging.getLogger(__name__)
FAILED_STARTS = 3
LONGEST_NAME = 100  # characters of who draws, which a task says
RESPITE = 2.0  # seconds until a host that had no room for a child is asked again
REMEDY = "give it fewer --slots, or this host more room (ulimit -n, ulimit -u, memory, the disk of temporary files)"
LONGEST_PAUSE = 30.0  # seconds before another child, where one after another ends without having done anything
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
        renew: Callable[[], object] = lambda: None,
    ) -> None:
        """`announced` are the tasks that its worker lets itself be asked for; `memory_limit` in bytes; 0: none.

        `renew` sees that `bundle` is there and whole, after a child that could not start: others write into the cache.
        """
        self.number = number
        self.ready = False
        self.drawn_by = "-"
        self._spec = spec
        self._bundle = bundle
        self._announced = announced
        self._events = events
        self._memory_limit = memory_limit
        self._renew = renew
        self._turns: deque[Turn] = deque()
        self._short = False  # the last turn was
        self._progress = (0, 0.0)  # steps, and when they were last seen to grow; while it starts, when that began
        self._life = 0
        self._failed_starts = 0
        self._fruitless = 0  # children in a row that ended without a finished turn
        self._start_at = 0.0
        self._child: ChildProcess | None = None  # `None` while it must wait for the next one
        self._ended_for, self._last_word = "", ""
        self._sent = 0  # turns given to this child
        self._shown = False
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
    def held(self) -> set[bytes]:
        """Digests of all its jobs that are wanted."""
        return {job.digest for turn in self._turns for job in turn.jobs if job.digest not in turn.unwanted}

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
        return self._child.steps if self._turns and self._child else 0

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._child.pid if self._child else 0

    def submit(self, work: Sequence[Work]) -> None:
        """Give the child a turn."""
        assert self._child is not None  # it is idle, or takes more
        self._sent += 1
        turn = Turn(self._sent, work)
        self._turns.append(turn)
        if len(self._turns) == 1:
            self._watch_anew()
        self._child.send(turn.number, turn.work)

    def show(self, wanted: bool) -> None:
        """Have steps of its turns shown from the next one on, by this child and those after it; or no more."""
        self._shown = wanted
        if self._child is not None:
            self._child.show(wanted)

    def work_of(self, life: int, seen: Seen) -> Work | None:
        """The job whose step was shown; `None` of a turn that is none of this child's any more."""
        if life != self._life or not self._turns or self._turns[0].number != seen.turn:
            return None
        work = self._turns[0].work
        return work[seen.episode] if seen.episode < len(work) else None

    def check(self, now: float, gap: float) -> None:
        """Kill a child that hangs in a turn or as it starts; `gap` is how long this host itself stood still.

        Where there is none, start one when its time has come.
        """
        if self._child is None:
            if now >= self._start_at:
                self._start()
            return
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
            if turn.unwanted == digests and self._child:
                self._child.give_up(turn.number)

    def handle(self, event: SlotEvent) -> tuple[Result, ...]:
        """Take one of this slot's events; the results of its turn, if that has ended."""
        if event.life != self._life:
            return ()
        if isinstance(event.word, Ready):
            self.ready, self.drawn_by = True, shortened(event.word.drawn_by, LONGEST_NAME) or "-"
            self._failed_starts = 0
            self._watch_anew()
        elif isinstance(event.word, Done):
            return self._end_turn(event.word)
        elif isinstance(event.word, Failure):
            self._last_word = event.word.text
        elif not isinstance(event.word, Seen):
            return self._replace()
        return ()

    def stop(self) -> None:
        """End the child."""
        self._life += 1
        if self._child is not None:
            self._child.close()

    def _watch_anew(self) -> None:
        self._progress = (0, monotonic())

    def _kill_after(self, limit: float, quiet: float, why: str) -> None:
        """Kill a child that has been quiet for longer than `limit` seconds; 0: never."""
        if quiet > limit > 0:
            self._ended_for = why
            if self._child is not None:
                self._child.kill()

    def _end_turn(self, done: Done) -> tuple[Result, ...]:
        turn = self._turns.popleft()
        self._fruitless = 0
        self._short = turn.size <= SMALL and bool(done.results) and sum(each.seconds for each in done.results) < SHORT
        self._watch_anew()
        if self._child and not self._turns and 0 < self._memory_limit < (held := self._child.memory):
            log.warning("slot %d holds %d MiB; starting another", self.number, held >> 20)
            self.stop()
            self._start()
        return done.results

    def _replace(self) -> tuple[Result, ...]:
        """Another child in the place of one that is gone; errors for the jobs that it had in its hands."""
        assert self._child is not None  # it was heard
        if not self._child.wait():
            self._ended_for = self._ended_for or self._last_word
        steps = self.steps
        ended_by = self._child.close()
        reason = self._ended_for or ended_by or self._last_word
        if not self.ready:
            self._count_failed_start(reason)
        lost = self._turns.popleft().jobs if self.ready and self._turns else []  # one that starts has begun nothing
        log.warning("slot %d ended (%s)%s; starting another", self.number, reason, _among(lost))
        self._start_after_pause()
        return tuple(
            Result(job.digest, None, steps // len(lost), 0.0, f"slot crashed ({reason})", None) for job in lost
        )

    def _count_failed_start(self, reason: str) -> None:
        self._failed_starts += 1
        if self._failed_starts >= FAILED_STARTS:
            raise DreamfleetError(f"a slot cannot start: {reason}; `dreamfleet doctor` looks for the cause")

    def _start_after_pause(self) -> None:
        """At once after a child that did something, ever later after those that did not: no host is kept busy so."""
        self._fruitless += 1
        self._vacate(0.0 if self._fruitless < 2 else min(2.0 ** (self._fruitless - 3), LONGEST_PAUSE))
        if self._fruitless < 2:
            self._start()

    def _vacate(self, pause: float) -> None:
        self.ready = self._short = False
        self._life += 1
        self._child = None
        self._start_at = monotonic() + pause

    def _start(self) -> None:
        """A new child; what waited for the last one goes to it."""
        self._vacate(0.0)
        self._ended_for, self._last_word = "", "the child ended"
        self._sent = 0
        number, life, events = self.number, self._life, self._events
        try:
            if self._failed_starts:
                self._renew()
            self._child = ChildProcess(
                self._spec,
                self._bundle,
                self._announced,
                lambda word: events.put(("slot", SlotEvent(number, life, word))),
            )
        except BundleError as error:
            self._count_failed_start(str(error))
            self._vacate(RESPITE)
            return
        except (OSError, RuntimeError) as error:  # no descriptor, process, thread or memory left, no place for a file
            self._count_failed_start(f"{error}; {REMEDY}")
            log.warning("slot %d cannot start a process yet: %s", number, error)
            self._vacate(RESPITE)
            return
        self._child.show(self._shown)
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
