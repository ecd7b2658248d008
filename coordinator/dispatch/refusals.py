"""Which workers may join a run: those of its protocol and task, and of its class if the run is strict. Pure."""

from typing import NamedTuple

from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.host_classes import effective_class
from dreamfleet.common.protocol.keys import PROTOCOL_VERSION, host_of
from dreamfleet.common.protocol.messages import HelloRequest
from dreamfleet.common.protocol.tasks import ARGUMENTS, is_unregistered, module_of

MAX_REFUSED = 8  # names that are remembered
MAX_LOGGED = 100  # refusals that are logged: an unknown sender can invent names without end
MAX_TASKS = 8  # of a worker that a refusal names
LONGEST = 600  # characters of what a worker says of itself: two of them fit into an answer


class Refusal(NamedTuple):
    """Why a worker may not join a run, and what to do; `task`: it may be started with that where its user trusts it."""

    why: str
    remedy: str
    task: str = ""


def find_refusal(
    request: HelloRequest, task: str, admitted: str | None, packages: tuple[str, ...] = NUMERIC_PACKAGES
) -> Refusal | None:
    """Why a worker cannot join a run of `task`; `None` if it may.

    `admitted` is the class of a strict run, `None` admits any. Fingerprints name the versions of `packages`. A worker
    that does not know its class yet may join; its class is checked when a heartbeat names it. R23: a refusal has a
    reason and a remedy, because somebody must act on it.
    """
    if not request.protocol_min <= PROTOCOL_VERSION <= request.protocol_max:
        worker = f"the worker (dreamfleet {truncate(request.package, LONGEST)})"
        spoken = f"{worker} speaks protocol {request.protocol_min} to {request.protocol_max}"
        remedy = f"install dreamfleet {package_version('dreamfleet')} on the worker's host"
        return Refusal(f"{spoken}, this run {PROTOCOL_VERSION}", remedy)
    family = task.partition(":")[0]
    if not ({task} if family in ARGUMENTS and module_of(task) else {task, family}) & set(request.tasks):
        remedy = "install the package that registers this task on the worker's host"
        if is_unregistered(task):
            remedy += "; or, if you trust it, start the worker with it"
        return Refusal(
            f"this run scores in {task!r}, which the worker does not know (it knows: {_describe_tasks(request.tasks)})",
            remedy,
            task if is_unregistered(task) else "",
        )
    if request.packages != packages:
        named, own = (truncate(", ".join(each), LONGEST) for each in (request.packages, packages))
        return Refusal(f"its fingerprint names {named}, this run's {own}", "start the worker again")
    host_class = effective_class(request.host_class, request.fingerprint, admitted)
    if admitted is None or host_class in ("", admitted):
        return None
    return class_mismatch(admitted, host_class, request.fingerprint)


def class_mismatch(run: str | None, host_class: str, fingerprint: str) -> Refusal:  # docs/how-to/mixed-hosts.md
    """Why a strict run refuses a worker of another class, and the remedy."""
    own, other, host = (truncate(each or "", LONGEST) for each in (run, host_class, fingerprint))
    return Refusal(
        f"classes differ: the run is --strict with class {own}, and this host has class {other} [{host}]",
        "install the same dreamfleet and package versions on a host of the same CPU features; or continue the run with "
        "--no-strict, which takes results of any host, but makes the run not repeatable bit by bit",
    )


def _describe_tasks(tasks: tuple[str, ...]) -> str:
    """A worker's tasks in words, cut to what an answer holds."""
    more = f" and {len(tasks) - MAX_TASKS} more" if len(tasks) > MAX_TASKS else ""
    return truncate(", ".join(tasks[:MAX_TASKS]), LONGEST) + more or "none"


class RefusedWorkers:
    """Workers that were refused, the latest last: the status shows them, as a run may wait for them."""

    def __init__(self) -> None:
        self.latest: dict[str, str] = {}  # name of a worker -> why
        self._logged = 0

    def add(self, worker: str, why: str) -> bool:
        """Remember a refusal; return whether to log it. All workers of a host count as one.

        R26: both the remembered names and the logged refusals are bounded.
        """
        name, why = host_of(worker), truncate(why, 2 * LONGEST)
        news = self.latest.pop(name, None) != why and self._logged < MAX_LOGGED
        self._logged += news
        self.latest[name] = why
        while len(self.latest) > MAX_REFUSED:
            del self.latest[next(iter(self.latest))]
        return news

    def remove(self, worker: str) -> None:
        """Forget a worker that could join after all."""
        self.latest.pop(host_of(worker), None)
