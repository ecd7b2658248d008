"""The steps on one host: connect, inspect, install, start, follow the log, end."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.printable import one_line
from dreamfleet.common.schema.validation import MAX_TEXT
from dreamfleet.coordinator.addons.spawn.agent import JOIN, JOIN_HERE, LEAST_FREE
from dreamfleet.coordinator.addons.spawn.answers import (
    EndAnswer,
    FollowAnswer,
    HostAnswer,
    InstallAnswer,
    StartAnswer,
    WorkerAnswer,
)
from dreamfleet.coordinator.addons.spawn.config import Host
from dreamfleet.coordinator.addons.spawn.connection import QUICK, SLOW, Connection
from dreamfleet.coordinator.addons.spawn.parcel import Parcel, pack, runs_here

T = TypeVar("T")
OnText = Callable[[str], None]
FAILED = "failed"


@dataclass(frozen=True)
class FleetAddress:
    """Where workers find their coordinator: endpoints, a join file's bytes, or both."""

    connect: tuple[str, ...]
    join: bytes = field(default=b"", repr=False)


@dataclass(frozen=True)
class HostStatus:
    """A row of the table of hosts; `slots` and `since` (seconds) are its worker's, `None` without one."""

    host: str
    state: str
    what: str
    slots: int | None = None
    since: float | None = None


class RemoteHost:
    """A host and the connection to it; every method raises `DreamfleetError` if it fails."""

    def __init__(self, host: Host, fleet_address: FleetAddress, on_progress: OnText, on_log_line: OnText) -> None:
        self.host = host
        self._fleet_address = fleet_address
        self._on_progress = on_progress
        self._on_log_line = on_log_line
        self._connection: Connection | None = None
        self._closed = threading.Event()
        self._root = {"root": host.spawn.remote_dir}
        self.forwards = host.forwards(fleet_address.connect, joins=bool(fleet_address.join))

    def check(self) -> HostStatus:
        """Describe the host and what `bring_up` would do; changes nothing."""
        found = self._inspect(())
        mine = next((each for each in found.workers if each.name == self.host.name and each.running), None)
        if mine:
            return self._status("running", mine)
        environment = self._environment(found)
        there = "is there" if environment in (None, *found.environments) else "is to be made"
        version = ".".join(map(str, found.python))
        return HostStatus(
            self.host.name,
            "ready",
            f"Python {version}, {found.machine}, {found.free / 1e9:.1f} GB free, its environment {there}",
        )

    def bring_up(self) -> HostStatus:
        """Start the worker, in an environment that is made if it is missing."""
        found = self._inspect(self.forwards)
        python = self._python(found)
        connect = self._endpoints()
        words = ["-P", "-m", "dreamfleet", "worker", "--name", self.host.name, "--slots", str(self.host.spawn.slots)]
        words += ["--connect", *connect] if connect else []
        words += ["--join", JOIN_HERE] if self._fleet_address.join else []
        words += self.host.flags
        facts: dict[str, Any] = {"python": python, "words": words, "env": self.host.environment}
        text = json.dumps(facts, sort_keys=True).encode() + hashlib.sha256(self._fleet_address.join).digest()
        files = {JOIN: self._fleet_address.join} if self._fleet_address.join else {}
        started = self._ask("start", StartAnswer, sent=files, **facts, name=self.host.name, slots=self.host.spawn.slots,
                            held=bool(self.forwards), digest=hashlib.sha256(text).hexdigest())  # fmt: skip
        return self._status(started.outcome, started)

    def follow(self) -> HostStatus | None:
        """Pass on the worker's log until it ends; `None` if `stop_following` ended this first."""
        followed = self._ask("follow", FollowAnswer, silence=None, name=self.host.name)
        return self._status("ended", followed) if followed.ended else None

    def stop_following(self) -> None:
        """End a running `follow`. From any thread."""
        if self._connection is not None:
            self._connection.interrupt()

    def end(self, *, all_workers: bool, now: bool, keep: bool) -> HostStatus:
        """End its worker, or all workers there, and remove their files."""
        if self._connection is None:
            self._connect(())
        names = None if all_workers else [self.host.name]
        ended = self._ask("end", EndAnswer, names=names, now=now, keep=keep).ended
        left = [each.name for each in ended if each.running]
        if left:
            return HostStatus(self.host.name, "left", f"{', '.join(left)} left")
        return HostStatus(self.host.name, "nothing", "no worker runs there")

    def close(self) -> None:
        """Close the connection, which ends a worker that uses its tunnel. From any thread."""
        self._closed.set()
        if self._connection is not None:
            self._connection.close()

    def _connect(self, forwards: tuple[str, ...]) -> None:
        spawn = self.host.spawn
        self._connection = Connection(self.host.ssh, self.host.address, spawn.remote_python, forwards)
        if self._closed.is_set():
            self._connection.close()
        self._connection.start_agent()

    def _inspect(self, forwards: tuple[str, ...]) -> HostAnswer:
        self._connect(forwards)
        found = self._ask("look", HostAnswer, silence=QUICK)
        self._check(found)
        return found

    def _check(self, found: HostAnswer) -> None:
        if not found.writable:
            raise DreamfleetError(f"{found.root} cannot be written there: name another --remote-dir")
        name = self._environment(found)
        if name is None:
            return
        if found.noexec:
            raise DreamfleetError(
                f"{found.root} is on a file system that is mounted noexec, and no environment runs from there: name "
                "another --remote-dir"
            )
        if name in found.environments:
            return
        if not found.venv:
            raise DreamfleetError("its Python has no venv: install it there (Debian: apt install python3-venv)")
        if found.free < LEAST_FREE:
            raise DreamfleetError(
                f"{found.free / 1e6:.0f} MB are free at {found.root}, and an environment takes "
                f"{LEAST_FREE / 1e6:.0f}: make room there, or name another --remote-dir"
            )
        pack_for(self.host.spawn.wheelhouse, found).check_fits(found.machine)

    def _environment(self, found: HostAnswer) -> str | None:
        """The worker's environment; `None` if dreamfleet is installed in the Python that the user named."""
        if self.host.spawn.remote_python and found.installed:
            return None
        return pack_for(self.host.spawn.wheelhouse, found).environment(found.python, found.machine)

    def _python(self, found: HostAnswer) -> str:
        """Install the worker if needed; the path of its Python."""
        name = self._environment(found)
        if name is None:
            return found.executable
        parcel = pack_for(self.host.spawn.wheelhouse, found)
        files = {} if name in found.environments else parcel.files()
        if files and not runs_here(found.system, found.machine):
            self._on_progress(f"is {found.system} on {found.machine}: gymnasium draws there, which is slower")
        made = self._ask("install", InstallAnswer, sent=files, environment=name, wheel=parcel.wheel.name,
                         offline=parcel.wheelhouse is not None)  # fmt: skip
        return made.python

    def _endpoints(self) -> list[str]:
        """The endpoints that the worker connects to: those given, or the remote ends of the tunnel."""
        if not self.forwards:
            return list(self._fleet_address.connect)
        assert self._connection is not None
        return [f"tcp/127.0.0.1:{port}" for port in self._connection.ports(self.forwards)]

    def _ask(
        self, do: str, answer: type[T], *, sent: Mapping[str, bytes] | None = None, silence: float | None = SLOW,
        **facts: object,
    ) -> T:  # fmt: skip
        assert self._connection is not None
        return self._connection.ask(do, answer, self._on_message, sent, silence, **self._root, **facts)

    def _on_message(self, kind: str, text: str) -> None:
        if kind == "line":
            self._on_log_line(text)
        else:
            self._on_progress(one_line(text[:MAX_TEXT]))

    def _status(self, state: str, worker: WorkerAnswer) -> HostStatus:
        return HostStatus(self.host.name, state, worker.last, worker.slots or None, worker.age)


def pack_for(wheelhouse: Path | None, found: HostAnswer) -> Parcel:
    """The parcel for the system and processor of a host."""
    return pack(wheelhouse, native=runs_here(found.system, found.machine))
