"""The forms of a host agent's answers. A host that answers in another form fails alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from dreamfleet.common.schema.validation import Count

Name = Annotated[str, Meta(max_length=4096)]
Line = Annotated[str, Meta(max_length=1 << 16)]


@dataclass(frozen=True)
class WorkerAnswer:
    """A worker on a host."""

    name: Name
    running: bool
    slots: Count | None
    age: float | None  # seconds since its start
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
    """The workers that `end` ended, as they were before."""

    ended: tuple[WorkerAnswer, ...]


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
