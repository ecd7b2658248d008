"""A round's evolution: a coordinator and, where they are wanted, scoring processes of this host."""

from __future__ import annotations

import re
import socket
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.errors import DreamfleetError, StoppedError
from dreamfleet.common.host.processes import VerbProcess, parent_death_command
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.stop_signals import Stop
from dreamfleet.coordinator.experiments.verb_process import wait

LEFT_OPEN = 130
ANY_ADDRESS = re.compile(r"/(0\.0\.0\.0|\[::\]):")  # where one listens, and connects to as this host


@dataclass(frozen=True)
class LocalFleet:
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
    ) -> LocalFleet:  # fmt: skip
        """As it was asked for: without an address on a free port of this host, scored by a slot a core."""
        joined = () if join is None else ("--join", str(join))
        security = (*joined, *(("--insecure",) if insecure else ()))
        here = f"{'tcp' if join is None else 'tls'}/127.0.0.1:{_free_port()}"
        slots = local if local is not None else 0 if listen else usable_cores()
        return cls(listen or (here,), slots, coordinator, (*worker, *joined), security)

    @property
    def local_endpoint(self) -> str:
        """The address for this host's own workers."""
        return ANY_ADDRESS.sub("/127.0.0.1:", self.listen[0])


def evolve(words: Sequence[str], run: str, local_fleet: LocalFleet, folder: Path, stop: Stop) -> None:
    """Serve a run until it ends; logs go into `folder`.

    `StoppedError` if it was left open, `DreamfleetError` if it failed, or if this host's workers did.
    """
    with ExitStack() as stack:
        coordinator = stack.enter_context(
            VerbProcess(*words, inside=parent_death_command(), log=folder / "coordinator.log")
        )
        workers = [stack.enter_context(_start_worker(run, local_fleet, folder))] if local_fleet.slots else []
        wait(coordinator, stop, lambda: _check_workers(workers))
        code, _ = coordinator.finish()
        if code == LEFT_OPEN:
            raise StoppedError(f"run {run} was left open")
        if code != 0:
            raise DreamfleetError(f"{coordinator.last_line()}; its words are in {folder / 'coordinator.log'}")


def _start_worker(run: str, local_fleet: LocalFleet, folder: Path) -> VerbProcess:
    words = (
        "worker",
        "--connect",
        local_fleet.local_endpoint,
        "--run",
        run,
        "--slots",
        local_fleet.slots,
        "--exit-when-done",
    )
    return VerbProcess(*words, *local_fleet.worker, inside=parent_death_command(), log=folder / "worker.log")


def _check_workers(workers: Sequence[VerbProcess]) -> None:
    for each in workers:
        if each.popen.poll() not in (None, 0):
            raise DreamfleetError(f"this host's worker failed: {each.last_line()}")


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])
