"""The workers of a run as lines of a terminal: columns go by worth, rows by need, and no name is cut. Pure."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from math import ceil
from statistics import median

from rich.cells import cell_len, chop_cells
from rich.text import Text

from dreamfleet.common.monitoring.eta import format_duration
from dreamfleet.common.monitoring.status import WorkerStatus
from dreamfleet.common.printable import printable

COLUMN_GAP = 2  # columns of air between two columns
SLOW_FACTOR = 1.5  # times the median of seconds a job: the slowest is marked from there on
COLUMNS: dict[str, Callable[[WorkerStatus], str]] = {
    "worker": lambda each: each.worker,
    "state": lambda each: each.state if each.state == "present" else f"{each.state} for {format_duration(each.heard)}",
    "slots": lambda each: str(each.slots),
    "a job": lambda each: "-" if each.job_seconds is None else format_duration(each.job_seconds),
    "round trip": lambda each: "-" if each.round_trip is None else f"< {format_duration(each.round_trip)}",
    "resent": lambda each: str(each.resent),
    "leases": lambda each: str(each.leases),
    "finished": lambda each: str(each.finished),
    "steps/s": lambda each: f"{each.steps_per_second:.0f}",
    "load": lambda each: str(each.load),
    "picture": lambda each: each.drawn_by,
}
DROP_ORDER = ("picture", "load", "leases", "finished", "steps/s", "resent", "round trip", "slots", "a job", "state")
LEFT_ALIGNED = ("worker", "state", "picture")


@dataclass(frozen=True)
class WorkerTable:
    """The workers that are told of, of `known`."""

    workers: Sequence[WorkerStatus]
    known: int

    def height(self, width: int) -> int:
        """Lines with which each of them is shown."""
        return 1 + sum(_row_height(each, width) for each in self.workers) + (self.known > len(self.workers))

    def lines(self, width: int, most: int) -> list[Text]:
        """At most `most` lines, 3 at least, of `width` columns: those of whom there is most to say, in their order."""
        slowest = find_slowest(self.workers)
        shown = set(range(len(self.workers)))
        if self.height(width) > most:
            room, shown = most - 2, set()
            for row in sorted(range(len(self.workers)), key=lambda row: _priority(self.workers[row], slowest)):
                room -= _row_height(self.workers[row], width)
                if room < 0 and shown:
                    break
                shown.add(row)
        found = _build_table(self.workers, shown, slowest, width)
        if self.known > len(shown):
            found.append(Text(f"and {self.known - len(shown)} more", style="dim"))
        return found


def find_slowest(workers: Sequence[WorkerStatus]) -> WorkerStatus | None:
    """The worker that takes longest for a job, if it stands out from the others."""
    times = {each.worker: each.job_seconds for each in workers if each.job_seconds is not None}
    last = max(workers, key=lambda each: times.get(each.worker, 0.0), default=None)
    return last if last and times and times.get(last.worker, 0.0) > SLOW_FACTOR * median(times.values()) else None


def _priority(each: WorkerStatus, slowest: WorkerStatus | None) -> tuple[bool, bool, float]:
    """Who is lost or silent comes first, then the slowest ones."""
    return each.state == "present", each is not slowest, -(each.job_seconds or 0.0)


def _row_height(each: WorkerStatus, width: int) -> int:
    return max(1, ceil(cell_len(printable(each.worker)) / max(width, 1)))


def _build_table(
    workers: Sequence[WorkerStatus], shown: Collection[int], slowest: WorkerStatus | None, width: int
) -> list[Text]:
    """A heading and the rows that are shown; the columns fit all workers, so that they stand still."""
    cells = {name: [printable(tell(each)) for each in workers] for name, tell in COLUMNS.items()}
    for row, each in enumerate(workers):
        cells["state"][row] += ", slowest" if each is slowest else ""
    widths = {name: max(map(cell_len, (name, *column))) for name, column in cells.items()}
    kept = list(COLUMNS)
    for name in DROP_ORDER:
        if sum(widths[each] + COLUMN_GAP for each in kept) - COLUMN_GAP > width:
            kept.remove(name)
    heading = (" " * COLUMN_GAP).join(_pad(name, name, widths[name]) for name in kept)
    found = [Text(heading.rstrip()[:width], style="dim")]
    for row in sorted(shown):
        each = workers[row]
        style = "red" if each.state != "present" else "yellow" if each is slowest else ""
        line = (" " * COLUMN_GAP).join(_pad(name, cells[name][row], widths[name]) for name in kept)
        found += [Text(part, style=style) for part in chop_cells(line.rstrip(), width)]
    return found


def _pad(name: str, text: str, width: int) -> str:
    air = " " * (width - cell_len(text))
    return text + air if name in LEFT_ALIGNED else air + text
