"""A run's status as a panel for a terminal of any size: the least important lines give way; no name is truncated.

Pages: security.md.
"""

import math
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise, zip_longest

from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.panel import Panel
from rich.text import Text

from dreamfleet.common.addons.analysis.scored_history import least_positive, spans_decades
from dreamfleet.common.client.run_view import LiveRunView, format_episodes
from dreamfleet.common.client.status import FailureStatus, Population, Status
from dreamfleet.common.printable import format_duration, format_number, plural, printable
from dreamfleet.common.protocol.function_values import fitness_word, is_minimised, value_of
from dreamfleet.common.protocol.tasks import is_unregistered
from dreamfleet.common.runs.records import in_values
from dreamfleet.common.security.credentials import EXPIRY_WARNING, describe_time_left
from dreamfleet.coordinator.addons.status.terminal_charts import (
    bar_chart,
    candidate_grid,
    candidate_grid_height,
    share_bar,
)
from dreamfleet.coordinator.addons.status.worker_table import WorkerTable, wrap

# `coordinator/run/shown_state.py` names the states, and the page colours them in `dashboard/page/live.js`.
STATE_STYLES = {
    "running": "green",
    "evaluating": "cyan",
    "paused": "bold red",
    "ended": "bold",
    "left": "bold yellow",
    "waiting for workers": "yellow",
    "waiting for a batch": "yellow",
}
FRAME_WIDTH = 4  # columns of border and padding
BORDER_LINES = 2
LABEL_WIDTH = 17  # columns of a fact's name
TWO_COLUMN_WIDTH = 110  # columns from which facts are in two columns
BAR_WIDTH = 24  # columns of the run's bar, or a third of a narrow terminal
MAX_CURVE_LINES = 8
UNKNOWN_ADDRESS = "--connect tcp/HOST:PORT"  # worker flags if the run's address is not known


@dataclass(frozen=True)
class Block:
    """A part of the panel: it is left out, or has from `min_lines` to `max_lines` lines."""

    priority: int  # blocks of lower numbers get lines first
    min_lines: int
    preferred_lines: int
    max_lines: int
    draw: Callable[[int], list[Text]]


class RunPanel:
    """The whole panel; if `fitted`, no higher than the terminal, for repeated drawing.

    `worker_flags` are the flags with which a worker joins the run, for display.
    """

    def __init__(self, status: Status, worker_flags: str = UNKNOWN_ADDRESS, *, fitted: bool = False) -> None:
        self._status = status
        self._worker_flags = worker_flags
        self._fitted = fitted

    def __rich_console__(self, _console: Console, options: ConsoleOptions) -> RenderResult:
        """A panel of the console's width."""
        status = self._status
        lines = options.max_height - BORDER_LINES - 1 if self._fitted else None  # one line for the shell's prompt
        state = printable(status.state), STATE_STYLES.get(status.state, "")
        title = Text.assemble((printable(status.run), "bold"), " · ", state)
        content = Group(*panel_lines(status, options.max_width - FRAME_WIDTH, lines, self._worker_flags))
        yield Panel(content, title=title, title_align="left", padding=(0, 1))


def panel_lines(
    status: Status, width: int, lines: int | None = None, worker_flags: str = UNKNOWN_ADDRESS
) -> list[Text]:
    """The panel without its frame, in `width` columns and at most `lines` lines; `None`: no limit."""
    blocks = list(_blocks(status, max(width, 1), worker_flags))
    return [line for block, given in zip(blocks, allocate_lines(blocks, lines), strict=True) if given
            for line in block.draw(given)[:given]]  # fmt: skip


def allocate_lines(blocks: Sequence[Block], lines: int | None) -> list[int]:
    """Give `lines` to the blocks by priority: first the minimum of each, then the preferred number, then the rest."""
    if lines is None:
        return [each.max_lines for each in blocks]
    given, left = [0] * len(blocks), lines
    order = sorted(range(len(blocks)), key=lambda index: blocks[index].priority)
    for index in order:
        if blocks[index].min_lines <= left:
            given[index] = blocks[index].min_lines
            left -= given[index]
    for target in ("preferred_lines", "max_lines"):
        for index in order:
            more = min(getattr(blocks[index], target) - given[index], left) if given[index] else 0
            given[index] += max(more, 0)
            left -= max(more, 0)
    return given


def _blocks(status: Status, width: int, worker_flags: str) -> Iterator[Block]:
    view = LiveRunView.of_status(status)
    yield _text_block(0, view.state, width, STATE_STYLES.get(status.state, ""), min_lines=2)
    for trouble, style in _troubles(status):
        yield _text_block(1, trouble, width, style)
    if not status.is_over:
        progress = _progress_lines(view, width)
        yield Block(2, 1, len(progress), len(progress), lambda given: progress[:given])
    facts = list(_facts(view))
    max_lines = len(_fact_lines(facts, width))
    yield Block(4, min(3, max_lines), min(5, max_lines), max_lines, lambda given: _fit_facts(facts, width, given))
    if len(status.recent) > 1:
        yield Block(7, 1, 4, MAX_CURVE_LINES, lambda given: _curve_lines(status, width, given))
    if (population := _open_population(status)) is not None:
        shown = population
        wanted = 1 + candidate_grid_height(shown, width)
        yield Block(5, 2, min(wanted, 4), wanted, lambda given: _candidate_lines(status, shown, width, given))
    yield _workers_block(status, width, worker_flags)


def _troubles(status: Status) -> Iterator[tuple[str, str]]:
    if status.failures and not status.why:
        yield _describe_failure(status.failures[0]), "red"
    if status.checks is not None and status.checks.waiting and not status.why:
        yield status.checks.waiting, "red"
    if status.equal_fitness:
        yield status.equal_fitness, "yellow"
    for each in status.refusals if status.worker_list else ():  # else they stand in place of the workers
        yield each, "yellow"


def _progress_lines(view: LiveRunView, width: int) -> list[Text]:
    share = view.eta.share
    bar = "" if share is None else f"{share_bar(share, min(BAR_WIDTH, width // 3))} {share:4.0%}  "
    lines = wrap(printable(view.eta.description), max(width - len(bar), 1))
    return [Text.assemble((bar, "cyan"), line) if row == 0 else Text(" " * len(bar) + line)
            for row, line in enumerate(lines)]  # fmt: skip


def _text_block(priority: int, text: str, width: int, style: str, min_lines: int = 1) -> Block:
    lines = [Text(each, style=style) for each in wrap(printable(text), width)]
    return Block(priority, min(min_lines, len(lines)), len(lines), len(lines), lambda given: lines[:given])


def _facts(view: LiveRunView) -> Iterator[tuple[int, str, str]]:
    """Priority (0 is highest), name and value of each fact, in display order."""
    status, stage = view.status, view.stage
    temperature, waste = status.generation.temperature, status.waste
    warm = "" if temperature is None or view.stage_settings.driven == 1 else f", temperature {temperature:g}"
    yield 6, "task", view.about + warm
    yield 7, "population", view.population
    if stage is not None:
        yield 4, "stage", f"{stage.number} of {len(view.settings.stages)}, since generation {stage.since}"
    last = "-" if view.last is None else f"average {format_number(view.last.mean)}, {view.spread}"
    yield 0, "last generation", last
    if view.settings.is_external:
        waiting = max(status.open_batches - bool(status.generation.episodes), 0)
        yield 3, "batches", f"{status.open_batches} open, {waiting} of them wait"
    else:
        yield 5, "step size", f"{format_number(status.generation.sigma)} ({view.optimiser})"
    if status.archive is not None:
        yield 1, "archive", status.archive.description
    for name, part in (("evaluation", status.evaluating), ("kept rollouts", status.collecting)):
        if part.episodes:
            yield 3, name, format_episodes(part)
    yield 1, "evaluated mean", view.describe(in_values(status.evaluation, view.task))
    provisional = ", provisional" if view.best and not view.confirmed else ""
    yield 2, "reported", view.describe(view.reported) + provisional
    yield 3, "throughput", f"{view.speed}, {status.throughput.environment_steps:,} {view.unit} in all"
    resent = f", {plural(waste.resent_batches, 'batch', 'batches')} resent" if waste.resent_batches else ""
    yield 4, "redundant work", f"{view.wasted}; {plural(waste.reissued, 'job')} reissued{resent}"
    if view.failed:
        here = status.generation.failed
        yield 2, "failed", f"{plural(view.failed, 'candidate')}, {here} of this generation; `story` lists why"
    if view.worked:
        yield 6, "time", view.worked
    if status.classes.total:
        yield 4 if status.classes.mixed or status.classes.varying else 7, "hosts", status.classes.description
    if (checks := status.checks) is not None:
        yield 2 if checks.differing or checks.barred or checks.waiting else 6, "checks", checks.description
    if status.expires is not None:
        left = datetime.fromtimestamp(status.expires, UTC) - datetime.now(UTC)
        yield 0 if left < EXPIRY_WARNING else 8, "join file", f"the coordinator's: {describe_time_left(left)}"
    if sum(status.dropped.values()):
        yield 8, "dropped messages", ", ".join(f"{count} {why}" for why, count in status.dropped.items())


def _fit_facts(facts: Sequence[tuple[int, str, str]], width: int, lines: int) -> list[Text]:
    """The facts of the highest priorities that fit into `lines`."""
    for count in range(len(facts), 0, -1):
        kept = sorted(facts, key=lambda each: each[0])[:count]
        drawn = _fact_lines([each for each in facts if each in kept], width)
        if len(drawn) <= lines:
            return drawn
    return drawn


def _fact_lines(facts: Sequence[tuple[int, str, str]], width: int) -> list[Text]:
    """Names and values as lines, in two columns if there is room."""
    half = (width - 2) // 2
    if width < TWO_COLUMN_WIDTH:
        return [line for each in facts for line in _fact(each, width)]
    found = []
    for left, right in zip_longest(facts[::2], facts[1::2]):
        cells = _fact(left, half), _fact(right, half) if right else []
        for one, other in zip_longest(*cells, fillvalue=Text()):
            one.pad_right(half + 2 - one.cell_len)
            found.append(one + other)
    return found


def _fact(each: tuple[int, str, str], width: int) -> list[Text]:
    _, name, value = each
    lines = wrap(printable(value), max(width - LABEL_WIDTH, 1)) or [""]
    return [
        Text.assemble(((name if row == 0 else "").ljust(LABEL_WIDTH), "dim"), line) for row, line in enumerate(lines)
    ]


def _describe_failure(failure: FailureStatus) -> str:
    worker, error = next(iter(failure.errors.items()), ("a worker", "no reason was given"))
    when = "" if failure.retry_in is None else f" in {format_duration(failure.retry_in)}"
    return f"{failure.subject}, failed on {worker}: {error}; it is tried again{when}"


def _open_population(status: Status) -> Population | None:
    """The candidates to show: the open generation's, or the last closed one's once the run is over."""
    population = status.last_population if status.is_over else status.population
    return population if population is not None and population.done else None


def _candidate_lines(status: Status, population: Population, width: int, lines: int) -> list[Text]:
    found = [each for each in population.candidates if each.fitness is not None]
    done, wanted = status.generation.episodes_done, status.generation.episodes
    if population.generation != status.generation.number:
        done, wanted = sum(population.done), sum(population.wanted)
    failed = sum(each.has_failed for each in population.candidates)
    if failed == population.total:
        parts = ["all candidates failed"]
    else:
        parts = [f"{done:,}/{plural(wanted, 'episode')}", *([f"{failed} failed (x)"] if failed else [])]
    if found:
        values = [value_of(each.fitness or 0.0, status.settings.task) for each in found]
        parts.append(f"so far {format_number(min(values))} to {format_number(max(values))}")
    if population.total > len(population.done):
        parts.append(f"the first {len(population.done)} of {population.total} candidates")
    caption = f"generation {population.generation}".ljust(LABEL_WIDTH) + ", ".join(parts)
    return [Text(caption[:width], style="dim"), *candidate_grid(population, width, lines - 1)]


def _curve_lines(status: Status, width: int, lines: int) -> list[Text]:
    """The average fitness of the last generations: a line of bars, or, with more lines, a bar chart under a caption.

    If there are more generations than columns, a bar is the mean of several. Generations of earlier stages are dim:
    their fitness may not be comparable.
    """
    task, stage = status.settings.task, status.generation.stage
    history = [in_values(each, task) for each in status.recent]
    caption = f"average {fitness_word(task)} by generation"
    margin = max(len(format_number(each.mean)) for each in history) + 1
    room = width - margin - (len(caption) + 1 + margin if lines == 1 else 0)
    means = _downsample([each.mean for each in history], max(room, 1))
    low, high = format_number(min(means)), format_number(max(means))
    since = 0 if stage is None else stage.since
    earlier = round(sum(each.number < since for each in history) / len(history) * len(means))  # bars
    if lines == 1:
        drawn = Text.assemble(
            (f"{caption} ", "dim"), f"{low} ", *_colour_bars(bar_chart(means, 1)[0], earlier), f" {high}"
        )
        return [drawn]
    wide = max(1, room // len(means))
    is_log = is_minimised(task) and spans_decades(means)
    heights = [math.log10(max(mean, least_positive(means))) if is_log else mean for mean in means]
    rows = bar_chart([each for each in heights for _ in range(wide)], lines - 1)
    marks = [high] if len(rows) == 1 else [high, *[""] * (len(rows) - 2), low]
    plot = [Text.assemble((f"{mark:>{margin - 1}} ", "dim"), *_colour_bars(row, earlier * wide))
            for mark, row in zip(marks, rows, strict=True)]  # fmt: skip
    each = "" if len(means) == len(history) else f", {round(len(history) / len(means))} to a bar"
    each += ", log scale" if is_log else ""
    begun = f", stage {stage.number} since {since}" if stage is not None and earlier else ""
    return [Text(f"{caption}, {history[0].number} to {history[-1].number}{each}{begun}"[:width], style="dim"), *plot]


def _colour_bars(row: str, earlier: int) -> tuple[tuple[str, str], tuple[str, str]]:
    return (row[:earlier], "dim green"), (row[earlier:], "green")


def _downsample(values: Sequence[float], max_count: int) -> list[float]:
    """At most `max_count` values: means of groups of neighbours of nearly equal size."""
    count = min(len(values), max_count)
    edges = [len(values) * each // count for each in range(count + 1)]
    return [sum(each / (last - first) for each in values[first:last]) for first, last in pairwise(edges)]


def _workers_block(status: Status, width: int, worker_flags: str) -> Block:
    if status.worker_list:
        roster = WorkerTable(status.worker_list, status.workers.known)
        height = roster.height(width)
        return Block(6, min(3, height), min(8, height), height, lambda given: roster.lines(width, given))
    task = status.settings.task.task
    task_flag = f" --task {shlex.quote(task)}" if is_unregistered(task) else ""
    none = "no worker is present" if status.throughput.environment_steps else "no workers yet"
    messages = status.refusals or [
        f"{none}; start one with",
        f"dreamfleet worker --run {status.run} {worker_flags}{task_flag}",
    ]
    lines = [Text(part, style="yellow") for each in messages for part in wrap(printable(each), width)]
    return Block(6, min(3, len(lines)), len(lines), len(lines), lambda given: lines[:given])
