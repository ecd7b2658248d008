"""Who may join a run: workers that speak its protocol and know its task; where it is strict, of one class. Pure."""

from __future__ import annotations

from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.host_classes import effective_class
from dreamfleet.common.protocol.keys import PROTOCOL_VERSION
from dreamfleet.common.protocol.messages import HelloRequest
from dreamfleet.common.protocol.tasks import is_unregistered

MOST_REFUSED = 8  # names that are remembered
MOST_TOLD = 100  # refusals that are news: no log should grow with what strangers call themselves
MOST_TASKS = 8  # of a worker that are told by name
LONGEST = 600  # characters of what a worker says of itself: two of them fit into an answer


def find_refusal(
    request: HelloRequest, task: str, admitted: str | None, packages: tuple[str, ...] = NUMERIC_PACKAGES
) -> tuple[str, str] | None:
    """Why a worker cannot join a run of `task` and what to do about it; `None` if it may.

    `admitted` is the class that the run keeps to, `None` admits any; fingerprints name the versions of `packages`. A
    worker that does not know its class yet may join, and is judged once it says it.
    """
    if not request.protocol_min <= PROTOCOL_VERSION <= request.protocol_max:
        spoken = f"the worker speaks protocol {request.protocol_min} to {request.protocol_max}"
        return f"{spoken}, this run {PROTOCOL_VERSION}", (
            f"install dreamfleet {package_version('dreamfleet')} on the worker's host"
        )
    if not {task, task.partition(":")[0]} & set(request.tasks):  # itself, or the family that it is of
        remedy = "install the package that registers this task on the worker's host"
        if is_unregistered(task):
            remedy = f"start it with `dreamfleet worker --task {task}`, if you trust that, or {remedy}"
        return (
            f"this run scores in {task!r}, which the worker does not know (it knows: {_describe_tasks(request.tasks)})",
            remedy,
        )
    if request.packages != packages:
        named, own = (truncate(", ".join(each), LONGEST) for each in (request.packages, packages))
        return f"its fingerprint names {named}, this run's {own}", ("say hello again about those")
    host_class = effective_class(request.host_class, request.fingerprint, admitted)
    if admitted is None or host_class in ("", admitted):
        return None
    return class_mismatch(admitted, host_class, request.fingerprint)


def class_mismatch(run: str | None, host_class: str, fingerprint: str) -> tuple[str, str]:
    """Why a worker of another class than a strict run's cannot add to it, and what to do about it."""
    own, other, host = (truncate(each or "", LONGEST) for each in (run, host_class, fingerprint))
    return f"classes differ: the run is strict, of class {own}, and this host is of {other} [{host}]", (
        "install the same dreamfleet and package versions on a host of the same CPU features; or continue the run with "
        "--no-strict, which takes results of any host, though its bits then hang on which host scored what"
    )


def _describe_tasks(tasks: tuple[str, ...]) -> str:
    """A worker's tasks in words: so many by name that an answer holds them."""
    more = f" and {len(tasks) - MOST_TASKS} more" if len(tasks) > MOST_TASKS else ""
    return truncate(", ".join(tasks[:MOST_TASKS]), LONGEST) + more or "none"


class RefusedWorkers:
    """Workers that could not join, the latest last: for whoever wonders why a run waits."""

    def __init__(self) -> None:
        self.latest: dict[str, str] = {}  # name of a worker -> why
        self._told = 0

    def add(self, worker: str, why: str) -> bool:
        """Remember one; whether that is news. A worker that is started again and again has one name, many lives."""
        name, why = worker.partition("/")[0], truncate(why, 2 * LONGEST)
        news = self.latest.pop(name, None) != why and self._told < MOST_TOLD
        self._told += news
        self.latest[name] = why
        while len(self.latest) > MOST_REFUSED:
            del self.latest[next(iter(self.latest))]
        return news

    def remove(self, worker: str) -> None:
        """It could join after all."""
        self.latest.pop(worker.partition("/")[0], None)
