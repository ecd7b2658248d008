"""Who may join a run: workers that know its task, on hosts that compute the same bits. Pure."""

from __future__ import annotations

from dreamfleet.common.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.messages import HelloRequest
from dreamfleet.common.printable import printable

MOST_REFUSED = 8  # names that are remembered


def refusal(
    request: HelloRequest, task: str, fingerprint: str | None, packages: tuple[str, ...] = NUMERIC_PACKAGES
) -> tuple[str, str] | None:
    """Why a worker cannot join a run of `task` and what to do about it; `None` if it may.

    `fingerprint` is the one that the run admits, `None` admits any; it names the versions of `packages`.
    """
    if not {task, task.partition(":")[0]} & set(request.tasks):  # itself, or the family that it is of
        known = printable(", ".join(request.tasks)) or "none"
        return f"this run scores in {task!r}, which the worker does not know (it knows: {known})", (
            "install the package that registers this task on the worker's host"
        )
    if request.packages != packages:
        return f"its fingerprint names {', '.join(request.packages)}, this run's {', '.join(packages)}", (
            "say hello again about those"
        )
    if fingerprint in (None, request.fingerprint):
        return None
    return differ(fingerprint, request.fingerprint)


def differ(run: str | None, worker: str) -> tuple[str, str]:
    """Why a worker of another fingerprint than the run's cannot add to it, and what to do about it."""
    return f"fingerprints differ: the run has [{printable(run or '')}], the worker [{printable(worker)}]", (
        "install the same package versions on a host of the same CPU features; or continue the run with --mixed, which "
        "takes results of any host, though their last bits may differ: the run then cannot be repeated to the bit"
    )


class Refusals:
    """Workers that could not join, the latest last: for whoever wonders why a run waits."""

    def __init__(self) -> None:
        self.latest: dict[str, str] = {}  # name of a worker -> why

    def add(self, worker: str, why: str) -> bool:
        """Remember one; whether that is news. A worker that is started again and again has one name, many lives."""
        name, why = worker.partition("/")[0], printable(why)
        news = self.latest.pop(name, None) != why
        self.latest[name] = why
        while len(self.latest) > MOST_REFUSED:
            del self.latest[next(iter(self.latest))]
        return news

    def admitted(self, worker: str) -> None:
        """It could join after all."""
        self.latest.pop(worker.partition("/")[0], None)
