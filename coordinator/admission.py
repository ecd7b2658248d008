"""Who may join a run: workers that know its task, on hosts that compute the same bits. Pure."""

from __future__ import annotations

from dreamfleet.common.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.messages import HelloRequest
from dreamfleet.common.printable import shortened

MOST_REFUSED = 8  # names that are remembered
MOST_TOLD = 100  # refusals that are news: no log should grow with what strangers call themselves
MOST_TASKS = 8  # of a worker that are told by name
LONGEST = 600  # characters of what a worker says of itself: two of them fit into an answer


def refusal(
    request: HelloRequest, task: str, fingerprint: str | None, packages: tuple[str, ...] = NUMERIC_PACKAGES
) -> tuple[str, str] | None:
    """Why a worker cannot join a run of `task` and what to do about it; `None` if it may.

    `fingerprint` is the one that the run admits, `None` admits any; it names the versions of `packages`.
    """
    if not {task, task.partition(":")[0]} & set(request.tasks):  # itself, or the family that it is of
        return f"this run scores in {task!r}, which the worker does not know (it knows: {_known(request.tasks)})", (
            "install the package that registers this task on the worker's host"
        )
    if request.packages != packages:
        named, own = (shortened(", ".join(each), LONGEST) for each in (request.packages, packages))
        return f"its fingerprint names {named}, this run's {own}", ("say hello again about those")
    if fingerprint in (None, request.fingerprint):
        return None
    return differ(fingerprint, request.fingerprint)


def differ(run: str | None, worker: str) -> tuple[str, str]:
    """Why a worker of another fingerprint than the run's cannot add to it, and what to do about it."""
    own, other = shortened(run or "", LONGEST), shortened(worker, LONGEST)
    return f"fingerprints differ: the run has [{own}], the worker [{other}]", (
        "install the same package versions on a host of the same CPU features; or continue the run with --mixed, which "
        "takes results of any host, though their last bits may differ: the run then cannot be repeated to the bit"
    )


def _known(tasks: tuple[str, ...]) -> str:
    """A worker's tasks in words: so many by name that an answer holds them."""
    more = f" and {len(tasks) - MOST_TASKS} more" if len(tasks) > MOST_TASKS else ""
    return shortened(", ".join(tasks[:MOST_TASKS]), LONGEST) + more or "none"


class Refusals:
    """Workers that could not join, the latest last: for whoever wonders why a run waits."""

    def __init__(self) -> None:
        self.latest: dict[str, str] = {}  # name of a worker -> why
        self._told = 0

    def add(self, worker: str, why: str) -> bool:
        """Remember one; whether that is news. A worker that is started again and again has one name, many lives."""
        name, why = worker.partition("/")[0], shortened(why, 2 * LONGEST)
        news = self.latest.pop(name, None) != why and self._told < MOST_TOLD
        self._told += news
        self.latest[name] = why
        while len(self.latest) > MOST_REFUSED:
            del self.latest[next(iter(self.latest))]
        return news

    def admitted(self, worker: str) -> None:
        """It could join after all."""
        self.latest.pop(worker.partition("/")[0], None)
