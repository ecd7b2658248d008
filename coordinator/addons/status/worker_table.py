"""A run's workers as a table of any size for a terminal; no name is truncated. No input or output.

In a narrow terminal columns are left out in `DROP_ORDER`, in a low one the rows of unremarkable workers.
"""

import textwrap
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from math import ceil
from statistics import median

from rich.cells import cell_len, chop_cells
from rich.text import Text

from dreamfleet.common.client.status import WorkerStatus
from dreamfleet.common.printable import format_duration, plural, printable

COLUMN_GAP = 2  # spaces between two columns
SLOW_FACTOR = 1.5  # the slowest worker is marked if its seconds a job exceed the median by this factor
COLUMNS: dict[str, Callable[[WorkerStatus], str]] = {
    "worker": lambda each: each.worker,
    "state": lambda each: each.state if each.state == "present" else f"{each.state} for {format_duration(each.heard)}",
    "slots": lambda each: str(each.slots),
    "per job": lambda each: "-" if each.job_seconds is None else format_duration(each.job_seconds),
    "round trip": lambda each: "-" if each.round_trip is None else f"< {format_duration(each.round_trip)}",
    "resent": lambda each: str(each.resent),
    "assigned": lambda each: str(each.leases),
    "finished": lambda each: str(each.finished),
    "steps/s": lambda each: f"{each.steps_per_second:,.0f}",
    "load": lambda each: str(each.load),
    "picture": lambda each: each.drawn_by,
}
DROP_ORDER = ("picture", "load", "assigned", "finished", "steps/s", "resent", "round trip", "slots", "per job", "state")
LEFT_ALIGNED = ("worker", "state", "picture")


@dataclass(frozen=True)
class WorkerTable:
    """The table of `workers`, which may be the first of `known` ones."""

    workers: Sequence[WorkerStatus]
    known: int

    def height(self, width: int) -> int:
        """The number of lines at which every worker is shown."""
        return 1 + sum(_row_height(each, width) for each in self.workers) + (self.known > len(self.workers))

    def lines(self, width: int, max_lines: int) -> list[Text]:
        """At most `max_lines` (3 or more) lines of `width` columns: the workers of the highest priority, in order."""
        slowest = find_slowest(self.workers)
        shown = set(range(len(self.workers)))
        if self.height(width) > max_lines:
            room, shown = max_lines - 2, set()
            for row in sorted(range(len(self.workers)), key=lambda row: _priority(self.workers[row], slowest)):
                room -= _row_height(self.workers[row], width)
                if room < 0 and shown:
                    break
                shown.add(row)
        found = _build_table(self.workers, shown, slowest, width)
        if self.known > len(shown):
            found.append(Text(f"and {plural(self.known - len(shown), 'more worker')}", style="dim"))
        return found


def find_slowest(workers: Sequence[WorkerStatus]) -> WorkerStatus | None:
    """The worker with the longest jobs, if these exceed the median by `SLOW_FACTOR`."""
    times = {each.worker: each.job_seconds for each in workers if each.job_seconds is not None}
    slowest = max(workers, key=lambda each: times.get(each.worker, 0.0), default=None)
    if slowest and times and times.get(slowest.worker, 0.0) > SLOW_FACTOR * median(times.values()):
        return slowest
    return None


def _priority(each: WorkerStatus, slowest: WorkerStatus | None) -> tuple[bool, bool, float]:
    """Sort key: workers that are not present first, then the slowest ones."""
    return each.state == "present", each is not slowest, -(each.job_seconds or 0.0)


def _row_height(each: WorkerStatus, width: int) -> int:
    return max(1, ceil(cell_len(printable(each.worker)) / max(width, 1))) + len(_reason_lines(each, width))


def _reason_lines(each: WorkerStatus, width: int) -> list[str]:
    """Why a worker left, beneath its row."""
    room, text = max(width - COLUMN_GAP, 1), printable(each.reason)
    return [f"{' ' * COLUMN_GAP}{line}" for line in wrap(text, room)]


def wrap(text: str, width: int) -> list[str]:
    """Wrap between words; text with wide characters anywhere."""
    return textwrap.wrap(text, width) if cell_len(text) == len(text) else chop_cells(text, width)


def _build_table(
    workers: Sequence[WorkerStatus], shown: Collection[int], slowest: WorkerStatus | None, width: int
) -> list[Text]:
    """A heading and the shown rows; column widths fit all workers, so that they do not change with the shown ones."""
    cells = {name: [printable(text_of(each)) for each in workers] for name, text_of in COLUMNS.items()}
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
        found += [Text(part, style=style) for part in _reason_lines(each, width)]
    return found


def _pad(name: str, text: str, width: int) -> str:
    padding = " " * (width - cell_len(text))
    return text + padding if name in LEFT_ALIGNED else padding + text
