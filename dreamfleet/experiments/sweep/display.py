"""A sweep's progress: a table in a terminal, else a line for each run that changes."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from dreamfleet.experiments.sweep.runner import RunProgress

LINE_INTERVAL = 10.0  # seconds between two lines about a run whose state stays
MOST_ROWS = 20  # of the table: open runs first


@contextmanager
def showing(progress: Sequence[RunProgress]) -> Iterator[Callable[[], None]]:
    """Yield a function that shows what has changed; it writes on stderr."""
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        lines = _Lines(progress, console)
        yield lines.update
        return
    with Live(_table(progress), console=console, refresh_per_second=4) as live:
        yield lambda: live.update(_table(progress))


class _Lines:
    """One line for each run that changed, seldom for one that only advanced."""

    def __init__(self, progress: Sequence[RunProgress], console: Console) -> None:
        self._progress, self._console = progress, console
        self._shown = {each.run.name: ("waiting", "", 0.0) for each in progress}

    def update(self) -> None:
        """Print what is new."""
        now = time.monotonic()
        for each in self._progress:
            state, text, at = self._shown[each.run.name]
            advanced = each.text != text and now - at > LINE_INTERVAL
            if each.state != state or advanced:
                self._shown[each.run.name] = each.state, each.text, now
                line = f"{each.run.name}: {each.state}{f', {each.text}' if each.text else ''}"
                self._console.print(line, markup=False, soft_wrap=True)


def _table(progress: Sequence[RunProgress]) -> Table:
    """The open and failed runs, then as many others as fit, under a line of totals."""
    counts = Counter(each.state for each in progress)
    totals = ", ".join(f"{count} {state}" for state, count in counts.items())
    table = Table(box=None, pad_edge=False, title=totals, title_justify="left", title_style="bold")
    for heading in ("run", "state", "how far"):
        table.add_column(heading, overflow="fold")
    ranks = {"running": 0, "failed": 1, "left open": 1, "finished": 2, "waiting": 3}
    shown = sorted(progress, key=lambda each: ranks[each.state])[:MOST_ROWS]
    for each in shown:
        table.add_row(*map(Text, (each.run.name, each.state, each.text)))  # names are no markup
    if len(progress) > len(shown):
        table.add_row("...", f"{len(progress) - len(shown)} more", "")
    return table
