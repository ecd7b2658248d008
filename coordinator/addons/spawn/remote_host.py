"""The steps on one host: connect, inspect, install, start, follow the log, end; and the forms of its agent's answers.

A host that answers in another form fails alone. Pages: upgrade.md.
"""

import hashlib
import json
import shlex
import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar

from msgspec import Meta

from dreamfleet.common.cli.key_values import split_flags
from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.printable import one_line
from dreamfleet.common.schema.validation import MAX_TEXT, Count
from dreamfleet.coordinator.addons.spawn.agent import JOIN, JOIN_HERE, LEAST_FREE
from dreamfleet.coordinator.addons.spawn.config import Host
from dreamfleet.coordinator.addons.spawn.connection import QUICK, SLOW, Connection
from dreamfleet.coordinator.addons.spawn.parcel import Parcel, pack, runs_here

Name = Annotated[str, Meta(max_length=4096)]
Line = Annotated[str, Meta(max_length=1 << 16)]
T = TypeVar("T")
OnText = Callable[[str], None]
FAILED = "failed"
NO_FILES: Mapping[str, bytes] = {}


@dataclass(frozen=True)
class WorkerAnswer:
    """A worker on a host."""

    name: Name
    running: bool
    slots: Annotated[int, Meta(ge=0, le=1 << 20)] | None
    age: Annotated[float, Meta(ge=0, le=1 << 32)] | None  # seconds since its start
    digest: Name | None
    last: Line  # of its log


@dataclass(frozen=True)
class StartAnswer(WorkerAnswer):
    """A worker after `start`."""

    outcome: Literal["started", "running", "replaced"]


@dataclass(frozen=True)
class FollowAnswer(WorkerAnswer):
    """A worker after `follow`."""

    ended: bool


@dataclass(frozen=True)
class EndAnswer:
    """The workers that `end` ended, as they were before, and the names of others that are there."""

    ended: tuple[WorkerAnswer, ...]
    stay: tuple[Name, ...]


@dataclass(frozen=True)
class InstallAnswer:
    """The Python of an environment."""

    python: Name


@dataclass(frozen=True)
class HostAnswer:
    """What `look` finds on a host."""

    python: Annotated[tuple[int, ...], Meta(min_length=2, max_length=2)]
    executable: Name
    machine: Name
    system: Name
    installed: Name | None  # the version of dreamfleet there
    venv: bool
    writable: bool
    noexec: bool  # whether no program may be run from its file system
    root: Name
    free: Count  # bytes
    environments: tuple[Name, ...]
    workers: tuple[WorkerAnswer, ...]


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
        self.host, self._fleet_address = host, fleet_address
        self._on_progress, self._on_log_line = on_progress, on_log_line
        self._connection: Connection | None = None
        self._closed = threading.Event()
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
        what = f"Python {version}, {found.machine}, {found.free / 1e9:.1f} GB free, its environment {there}"
        return HostStatus(self.host.name, "ready", what)

    def bring_up(self) -> HostStatus:
        """Start the worker, in an environment that is made if it is missing."""
        found = self._inspect(self.forwards)
        python, connect = self._python(found), self._fleet_address.connect
        join, spawn = self._fleet_address.join, self.host.spawn
        if self.forwards and self._connection is not None:  # the remote ends of the tunnel
            connect = tuple(f"tcp/127.0.0.1:{port}" for port in self._connection.ports(self.forwards))
        words = ["-P", "-m", "dreamfleet", "worker", "--name", self.host.name, "--slots", str(spawn.slots)]
        words += ["--connect", *connect] if connect else []
        words += ["--join", JOIN_HERE] if join else []
        words += split_flags("--worker-flags", spawn.worker_flags)
        environment = dict(each.partition("=")[::2] for each in spawn.env)
        facts: dict[str, Any] = {"python": python, "words": words, "env": environment}
        digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode() + hashlib.sha256(join).digest()).hexdigest()
        started = self._ask("start", StartAnswer, sent={JOIN: join} if join else {}, **facts, name=self.host.name,
                            slots=spawn.slots, held=bool(self.forwards), digest=digest)  # fmt: skip
        return self._status(started.outcome, started)

    def follow(self) -> HostStatus | None:
        """Pass on the worker's log until it ends; `None` if `stop_following` ended this first."""
        followed = self._ask("follow", FollowAnswer, silence=None, name=self.host.name)
        return self._status("ended", followed) if followed.ended else None

    def stop_following(self) -> None:
        """End a running `follow`. From any thread."""
        if self._connection is not None:
            self._connection.interrupt()

    def end(self, *, all_workers: bool, now: bool, keep: bool, known: Collection[str] = ()) -> HostStatus:
        """End its worker, or all workers there, and remove their files; name those that stay, but for `known` ones."""
        if self._connection is None:
            self._connect(())
        names = None if all_workers else [self.host.name]
        answer = self._ask("end", EndAnswer, names=names, now=now, keep=keep)
        stay = ", ".join(each for each in answer.stay if known and each not in known)
        more = f"; {stay} is there too: `dreamfleet down {shlex.quote(self.host.address)}` ends all" if stay else ""
        if left := [each.name for each in answer.ended if each.running]:
            return HostStatus(self.host.name, "left", f"{', '.join(left)} left{more}")
        return HostStatus(self.host.name, "nothing", f"no worker{' of this name' if stay else ''} runs there{more}")

    def close(self) -> None:
        """Close the connection, which ends a worker that uses its tunnel. From any thread."""
        self._closed.set()
        if self._connection is not None:
            self._connection.close()

    def release(self) -> None:
        """As `close`, once no method of this host runs."""
        self.close()
        if self._connection is not None:
            self._connection.release()

    def _connect(self, forwards: tuple[str, ...]) -> None:
        spawn = self.host.spawn
        ssh = split_flags("--ssh", spawn.ssh)
        self._connection = Connection(ssh, self.host.address, spawn.remote_python, forwards)
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
                f"{found.root} is on a file system that is mounted `noexec`, and no environment runs from there: name "
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
        self._parcel(found).check_fits(found.machine)

    def _environment(self, found: HostAnswer) -> str | None:
        """The worker's environment; `None` if dreamfleet is installed in the Python that the user named."""
        if self.host.spawn.remote_python and found.installed:
            return None
        return self._parcel(found).environment(found.python, found.machine)

    def _parcel(self, found: HostAnswer) -> Parcel:
        return pack(self.host.spawn.wheelhouse, native=runs_here(found.system, found.machine))

    def _python(self, found: HostAnswer) -> str:
        """Install the worker if needed; the path of its Python."""
        name = self._environment(found)
        if name is None:
            return found.executable
        parcel = self._parcel(found)
        files = {} if name in found.environments else parcel.files()
        if files and not runs_here(found.system, found.machine):
            self._on_progress(f"is {found.system} on {found.machine}: gymnasium draws there, which is slower")
        offline = parcel.wheelhouse is not None
        return self._ask(
            "install", InstallAnswer, sent=files, environment=name, wheel=parcel.wheel.name, offline=offline
        ).python

    def _ask(
        self, do: str, answer: type[T], *, sent: Mapping[str, bytes] = NO_FILES, silence: float | None = SLOW,
        **facts: object,
    ) -> T:  # fmt: skip
        assert self._connection is not None
        root = self.host.spawn.remote_dir
        return self._connection.ask(do, answer, self._on_message, sent, silence, root=root, **facts)

    def _on_message(self, kind: str, text: str) -> None:
        if kind == "line":
            self._on_log_line(text)
        else:
            self._on_progress(one_line(text[:MAX_TEXT]))

    def _status(self, state: str, worker: WorkerAnswer) -> HostStatus:
        return HostStatus(self.host.name, state, worker.last, worker.slots or None, worker.age)
