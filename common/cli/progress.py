"""Progress bars."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.measure import Measurement
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table

WIDEST = 10_000  # columns: where nothing is cut any more
LOG_INTERVAL = 60.0  # seconds between two lines of a bar that is drawn nowhere, such as into a log
BAR_WIDTH, MIN_BAR_WIDTH = 40, 8  # columns that a bar has where there is room, and before others are left out for it


class Bar:
    """One bar."""

    def __init__(self, progress: Progress, description: str, total: int) -> None:
        self._progress = progress
        self._task = progress.add_task(description, total=total, note="")
        self._last_logged = time.monotonic()

    def update(self, done: int, note: str = "") -> None:
        """So many are done; `note` stands behind the bar. Where no bar moves, its line is said once a minute."""
        self._progress.update(self._task, completed=done, note=note)
        console = self._progress.console
        drawn = console.is_terminal and not console.is_dumb_terminal
        if not drawn and time.monotonic() - self._last_logged >= LOG_INTERVAL:
            self._last_logged = time.monotonic()
            console.print(self._progress.get_renderable())


class FittedProgress(Progress):
    """A progress whose line is never cut: the bar shrinks, then the columns in `least_first` are left out."""

    def __init__(self, *columns: ProgressColumn, least_first: Sequence[ProgressColumn], console: Console) -> None:
        self._least_first, self._console = least_first, console
        super().__init__(*columns, console=console)

    def make_tasks_table(self, tasks: Iterable[Task]) -> Table:
        """The line as it fits now."""
        tasks, every = list(tasks), self.columns
        table = super().make_tasks_table(tasks)
        try:
            for each in self._least_first:
                if self._minimum_width(table) <= self._console.width:
                    break
                self.columns = tuple(column for column in self.columns if column is not each)
                table = super().make_tasks_table(tasks)
        finally:
            self.columns = every
        return table

    def _minimum_width(self, table: Table) -> int:
        """Columns in which nothing is cut while the bar has `MIN_BAR_WIDTH`."""
        drawn = Measurement.get(self._console, self._console.options.update(max_width=WIDEST), table).maximum
        return drawn - (BAR_WIDTH - MIN_BAR_WIDTH) * any(isinstance(each, BarColumn) for each in self.columns)


def make_progress(unit: str, console: Console) -> Progress:
    """A bar with how many of what are done, time gone and time left."""
    gone, left, word = TimeElapsedColumn(), TextColumn("left"), TextColumn(unit)
    bar = BarColumn(None, table_column=Column(max_width=BAR_WIDTH))
    columns = (
        TextColumn("{task.description}"), bar, MofNCompleteColumn(), word, gone, left, TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )  # fmt: skip
    return FittedProgress(*columns, least_first=(gone, word, left, bar), console=console)


@contextmanager
def progress_bar(description: str, total: int, unit: str) -> Iterator[Bar]:
    """A bar on stderr with time gone and time left; none where warnings and errors alone are wanted (`-q`)."""
    quiet = logging.getLogger("dreamfleet").level > logging.INFO
    with make_progress(unit, Console(stderr=True, quiet=quiet)) as progress:
        yield Bar(progress, description, total)
