"""Progress bars."""

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

from dreamfleet.common.cli.output import UNLIMITED_WIDTH
from dreamfleet.common.host.foreign_code import answer_kept

LARGEST_TOTAL = 10**15  # items: of more, rich cannot estimate the remaining time
SPEED_PERIOD = 600.0  # seconds of the past that the remaining time is estimated from: steps may take a minute
LOG_INTERVAL = 30.0  # seconds between two lines where no bar can be drawn, such as in a log
BAR_WIDTH, MIN_BAR_WIDTH = 40, 8  # columns of a bar: preferred, and the least before other columns are left out


class Bar:
    """One progress bar."""

    def __init__(self, progress: Progress, description: str, total: int) -> None:
        self._progress = progress
        self._task = progress.add_task(description, total=min(total, LARGEST_TOTAL), note="")
        self._last_logged = time.monotonic()

    def update(self, done: int, note: str = "") -> None:
        """Set the number of finished items and the note after the bar; where no bar is drawn, log twice a minute."""
        self._progress.update(self._task, completed=done, note=note)
        console = self._progress.console
        drawn = console.is_terminal and not console.is_dumb_terminal
        if not drawn and time.monotonic() - self._last_logged >= LOG_INTERVAL:
            self._last_logged = time.monotonic()
            console.print(self._progress.get_renderable())

    def end(self, done: int, note: str = "") -> None:
        """Fill the bar of what ended after `done` items, as a drive that may be shorter than planned."""
        self._progress.update(self._task, total=done, completed=done, note=note)


class FittedProgress(Progress):
    """A progress line that is never truncated: the bar shrinks, then columns are left out in `drop_order`."""

    def __init__(self, *columns: ProgressColumn, drop_order: Sequence[ProgressColumn], console: Console) -> None:
        self._drop_order, self._console = drop_order, console
        super().__init__(*columns, console=console, speed_estimate_period=SPEED_PERIOD)

    def make_tasks_table(self, tasks: Iterable[Task]) -> Table:
        """The line with the columns that fit the console's width now."""
        tasks, all_columns = list(tasks), self.columns
        table = super().make_tasks_table(tasks)
        try:
            for each in self._drop_order:
                if self._minimum_width(table) <= self._console.width:
                    break
                self.columns = tuple(column for column in self.columns if column is not each)
                table = super().make_tasks_table(tasks)
        finally:
            self.columns = all_columns
        return table

    def _minimum_width(self, table: Table) -> int:
        """The width at which nothing is truncated while the bar has `MIN_BAR_WIDTH`."""
        drawn = Measurement.get(self._console, self._console.options.update(max_width=UNLIMITED_WIDTH), table).maximum
        return drawn - (BAR_WIDTH - MIN_BAR_WIDTH) * any(isinstance(each, BarColumn) for each in self.columns)


def make_progress(unit: str, console: Console) -> Progress:
    """A progress bar with the number of finished units, elapsed time and remaining time."""
    elapsed, left, word = TimeElapsedColumn(), TextColumn("left"), TextColumn(unit)
    bar = BarColumn(None, table_column=Column(max_width=BAR_WIDTH))
    columns = (
        TextColumn("{task.description}"), bar, MofNCompleteColumn(), word, elapsed, left, TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )  # fmt: skip
    return FittedProgress(*columns, drop_order=(elapsed, word, left, bar), console=console)


@contextmanager
def progress_bar(description: str, total: int, unit: str) -> Iterator[Bar]:
    """A progress bar on stderr; hidden when only warnings and errors are logged (`-q`).

    A simulator may work inside: what is printed meanwhile goes to stderr too, and the current folder is kept.
    """
    quiet = logging.getLogger("dreamfleet").level > logging.INFO
    with answer_kept(), make_progress(unit, Console(stderr=True, quiet=quiet)) as progress:
        yield Bar(progress, description, total)
