"""A round's evolution: a coordinator and, where they are wanted, scoring processes of this host."""

from __future__ import annotations

import re
import socket
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.cores import cores
from dreamfleet.common.errors import DreamfleetError, StoppedError
from dreamfleet.common.processes import Child, leash
from dreamfleet.common.stopping import Stop
from dreamfleet.coordinator.iteration.process import wait

LEFT_OPEN = 130
EVERYWHERE = re.compile(r"/(0\.0\.0\.0|\[::\]):")  # where one listens, and connects to as this host


@dataclass(frozen=True)
class Crew:
    """Where a run is reached, how many of its slots are here, and flags that its verbs need besides."""

    listen: tuple[str, ...]
    slots: int
    coordinator: tuple[str, ...] = ()
    worker: tuple[str, ...] = ()
    security: tuple[str, ...] = ()  # of its coordinators, begun or resumed

    @classmethod
    def of(
        cls, listen: tuple[str, ...], local: int | None, coordinator: tuple[str, ...], worker: tuple[str, ...],
        join: Path | None = None, *, insecure: bool = False,
    ) -> Crew:  # fmt: skip
        """As it was asked for: without an address on a free port of this host, scored by a slot a core."""
        joined = () if join is None else ("--join", str(join))
        security = (*joined, *(("--insecure",) if insecure else ()))
        here = f"{'tcp' if join is None else 'tls'}/127.0.0.1:{_free_port()}"
        slots = local if local is not None else 0 if listen else cores()
        return cls(listen or (here,), slots, coordinator, (*worker, *joined), security)

    @property
    def near(self) -> str:
        """The address for this host's own workers."""
        return EVERYWHERE.sub("/127.0.0.1:", self.listen[0])


def evolve(words: Sequence[str], run: str, crew: Crew, folder: Path, stop: Stop) -> None:
    """Serve a run until it ends; logs go into `folder`.

    `StoppedError` if it was left open, `DreamfleetError` if it failed, or if this host's workers did.
    """
    with ExitStack() as stack:
        coordinator = stack.enter_context(Child(*words, inside=leash(), log=folder / "coordinator.log"))
        workers = [stack.enter_context(_worker(run, crew, folder))] if crew.slots else []
        wait(coordinator, stop, lambda: _check(workers))
        code, _ = coordinator.finish()
        if code == LEFT_OPEN:
            raise StoppedError(f"run {run} was left open")
        if code != 0:
            raise DreamfleetError(f"{coordinator.last_words()}; its words are in {folder / 'coordinator.log'}")


def _worker(run: str, crew: Crew, folder: Path) -> Child:
    words = ("worker", "--connect", crew.near, "--run", run, "--slots", crew.slots, "--exit-when-done")
    return Child(*words, *crew.worker, inside=leash(), log=folder / "worker.log")


def _check(workers: Sequence[Child]) -> None:
    for each in workers:
        if each.popen.poll() not in (None, 0):
            raise DreamfleetError(f"this host's worker failed: {each.last_words()}")


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])
