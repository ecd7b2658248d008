"""A run's status as tables for a terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from dreamfleet.common.printable import printable
from dreamfleet.common.status import FailureStatus, OpenGeneration, Progress, Status, WorkerStatus
from dreamfleet.common.stored import RunSettings, StoredConfirmation, StoredEvaluation, StoredGeneration

STATE_STYLES = {
    "running": "green",
    "evaluating": "cyan",
    "paused": "bold red",
    "ended": "bold",
    "left": "bold yellow",
    "waiting for workers": "yellow",
}
SPARKS = "▁▂▃▄▅▆▇█"
SPARK_WIDTH = 60
MOST_WORKERS = 20
PAD = 2  # columns of air on each side of a cell
COLUMNS: dict[str, Callable[[WorkerStatus], str]] = {
    "worker": lambda each: each.worker,
    "state": lambda each: each.state,
    "slots": lambda each: str(each.slots),
    "leases": lambda each: str(each.leases),
    "finished": lambda each: str(each.finished),
    "steps/s": lambda each: f"{each.steps_per_second:.0f}",
    "load": lambda each: str(each.load),
    "picture": lambda each: each.drawn_by,
}
LEAST_FIRST = ("picture", "load", "leases", "finished", "slots", "steps/s", "state")
LEFT = ("worker", "state", "picture")


def run_panel(status: Status) -> RenderableType:
    """The whole picture: state, generation, fitness, fleet."""
    state = printable(status.state), STATE_STYLES.get(status.state, "")
    title = Text.assemble((printable(status.run), "bold"), " · ", state)
    parts: list[RenderableType] = [_facts(status)]
    if status.why:
        parts.append(Text(printable(status.why), style="bold red" if status.state == "paused" else ""))
    elif status.failures:
        parts.append(Text(printable(_failure(status.failures[0])), style="red"))
    parts.append(_progress(status))
    if status.recent:
        parts.append(Text.assemble(("mean fitness by generation  ", "dim"), _sparkline(status.recent)))
    parts.append(_worker_table(status))
    return Panel(Group(*parts), title=title, title_align="left", padding=(0, 1))


def _facts(status: Status) -> Table:
    settings, task, waste = status.settings, status.settings.task, status.waste
    grid = Table.grid(padding=(0, 3, 0, 1))
    grid.add_column(style="dim")
    grid.add_column()
    grid.add_column(style="dim")
    grid.add_column()
    temperature = status.generation.temperature
    warm = "" if temperature is None else f", temperature {temperature:g}"
    stage = status.generation.stage
    now = task if stage is None else stage
    size = settings if stage is None else stage

    def row(*cells: str) -> None:
        grid.add_row(*(Text(printable(each)) for each in cells))  # texts of others are no markup

    row(
        "task",
        f"{task.task}, {now.horizon} steps{warm}",
        "population",
        f"{size.population} x {size.episodes}",
    )
    if stage is not None:
        row("stage", f"{stage.number} of {stage.total}, since generation {stage.since}")
    row(
        "last generation", _spread(status.last) if status.last else "-",
        "step size", f"{status.generation.sigma:.4f} ({_optimiser(settings)})",
    )  # fmt: skip
    row("evaluated mean", _evaluated(status.evaluation), "reported", _reported(status))
    steps, rate = status.throughput.environment_steps, status.throughput.steps_per_second
    row(
        "throughput", f"{rate:,.0f} steps/s, {steps:,} in all",
        "waste", f"{waste.share:.1%}, {waste.reissued} jobs issued again",
    )  # fmt: skip
    if sum(status.dropped.values()):
        row("dropped messages", ", ".join(f"{count} {why}" for why, count in status.dropped.items()))
    return grid


def _spread(last: StoredGeneration) -> str:
    return f"{last.mean:.1f} ± {last.std:.1f}  ({last.worst:.0f} to {last.best:.0f})"


def _optimiser(settings: RunSettings) -> str:
    return settings.covariance if settings.optimiser == "cma" else settings.optimiser


def _evaluated(each: StoredEvaluation | StoredConfirmation | None) -> str:
    if each is None:
        return "-"
    tracks = f"{each.episodes} fresh tracks" if isinstance(each, StoredConfirmation) else f"{each.episodes} tracks"
    return f"{each.mean:.1f} ± {each.error:.1f} on {tracks} (generation {each.generation})"


def _reported(status: Status) -> str:
    if status.confirmed is not None or status.best is None:
        return _evaluated(status.confirmed)
    return f"{_evaluated(status.best)}, provisional"


def _failure(failure: FailureStatus) -> str:
    worker, error = next(iter(failure.errors.items()), ("a worker", "no reason was given"))
    return f"candidate {failure.candidate} failed on {worker}: {error}; another worker will try"


def _progress(status: Status) -> Table:
    grid = Table.grid(padding=(0, 2, 0, 1))
    parts: dict[str, OpenGeneration | Progress] = {
        f"generation {status.generation.number}": status.generation,
        "evaluation": status.evaluating,
        "confirmation": status.confirming,
        "kept rollouts": status.collecting,
    }
    for label, part in parts.items():
        if part.episodes and not (part is status.generation and status.state in ("ended", "evaluating")):
            done, wanted = part.episodes_done, part.episodes
            grid.add_row(label, ProgressBar(wanted, done, width=40), f"{done}/{wanted} episodes")
    return grid


def _sparkline(history: Sequence[StoredGeneration]) -> Text:
    means = [each.mean for each in history][-SPARK_WIDTH:]
    low, high = min(means), max(means)
    span = high / 2 - low / 2  # halves, so that no difference overflows
    bars = "".join(SPARKS[round((mean / 2 - low / 2) / span * (len(SPARKS) - 1)) if span > 0 else 0] for mean in means)
    return Text.assemble(f"{low:.0f} ", (bars, "green"), f" {high:.0f}")


def _worker_table(status: Status) -> RenderableType:
    if not status.worker_list:
        lines = [f"worker {name} cannot join: {why}" for name, why in status.refused.items()]
        lines = lines or ["no workers yet: start one with  dreamfleet worker --connect tcp/HOST:PORT"]
        return Text("\n".join(map(printable, lines)), style="yellow")
    return WorkerTable(status.worker_list[:MOST_WORKERS], status.workers.known)


class WorkerTable:
    """Workers, a row each: where the terminal is narrow, the columns that matter least are left out, never a name."""

    def __init__(self, workers: Sequence[WorkerStatus], known: int) -> None:
        self._workers = workers
        self._known = known

    def __rich_console__(self, _console: Console, options: ConsoleOptions) -> RenderResult:
        """As many columns as fit, in their order."""
        cells = {name: [printable(tell(each)) for each in self._workers] for name, tell in COLUMNS.items()}
        widths = {name: max(map(cell_len, (name, *column))) + 2 * PAD for name, column in cells.items()}
        kept = list(COLUMNS)
        for name in LEAST_FIRST:
            if sum(widths[each] for each in kept) > options.max_width:
                kept.remove(name)
        table = Table(box=None, padding=(0, PAD), header_style="dim")
        for name in kept:
            justify = "left" if name in LEFT else "right"
            table.add_column(name, justify=justify, overflow="fold")  # type: ignore[arg-type]
        for row, each in enumerate(self._workers):
            table.add_row(*(Text(cells[name][row]) for name in kept), style="" if each.state == "present" else "red")
        if self._known > len(self._workers):
            table.add_row(f"and {self._known - len(self._workers)} more")
        yield table
