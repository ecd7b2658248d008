"""How a sweep is served: how many runs at a time, with how many workers, and where they meet."""

from __future__ import annotations

from dataclasses import dataclass

from dreamfleet.common.errors import UsageError

PARALLEL, MOST_PARALLEL, MOST_WORKERS = 4, 64, 1024


@dataclass(frozen=True)
class SweepOptions:
    """What flags or a file say of serving a sweep, and defaults for the rest; `UsageError` if it cannot be."""

    parallel: int = PARALLEL
    workers: int | None = None  # one a core, or none with `connect`
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    insecure: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.parallel <= MOST_PARALLEL:
            raise UsageError(f"--parallel must be from 1 to {MOST_PARALLEL}, not {self.parallel}")
        if self.workers is not None and not 0 <= self.workers <= MOST_WORKERS:
            raise UsageError(f"--workers must be from 0 to {MOST_WORKERS}, not {self.workers}")
        if self.listen and self.connect:
            raise UsageError("--listen starts a router here and --connect uses another one: give one of them")
