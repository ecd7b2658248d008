"""A run's state in a sentence, and its estimated time to the end, computed from a status. No input or output."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from statistics import median, median_low
from typing import Any

from dreamfleet.common.client.status import EpisodeProgress, Status, WorkerCount
from dreamfleet.common.printable import format_number, plural
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.tasks import step_unit
from dreamfleet.common.runs.effort import format_steps
from dreamfleet.common.runs.records import describe_score, format_mean, in_values

PACE_WINDOW = 10  # closed generations that tell the pace
STALL_SECONDS = 60.0  # how long a generation that is overdue makes no step until its end is unknown
ACTIVE_STATES = ("running", "evaluating")


@dataclass(frozen=True)
class LimitProgress:
    """The progress of a run towards one of its limits."""

    name: str  # generations, steps, minutes
    done: float
    wanted: float
    seconds: float | None  # until it is reached at the present pace; `None` if that is not known yet
    description: str  # "18 of 30 minutes"

    @property
    def share(self) -> float:
        """The done share, from 0 to 1."""
        return min(max(self.done / self.wanted, 0.0), 1.0)


@dataclass(frozen=True)
class Eta:
    """The estimated end of a run: its limits, then the last evaluations and the confirmation."""

    bounds: tuple[LimitProgress, ...]  # countable limits, the nearest first
    others: tuple[str, ...]  # limits whose time cannot be estimated, in words
    pace: float | None  # seconds a generation; `None` before the first is closed
    limit: float | None  # seconds until the first limit; `None` if unknown, or while nobody scores or nothing moves
    seconds: float | None  # until the run's end; `None` also if the speed of evaluations is unknown
    closing: int = 0  # episodes of evaluations between the limit and the run's end

    @property
    def description(self) -> str:
        """A text such as "18 of 30 minutes, 4.6 s a generation, about 12 min to go"."""
        parts = [each.description for each in self.bounds] + list(self.others)
        parts = parts or ["no limit: it runs until it is stopped"]
        if self.pace is not None:
            parts.append(f"{format_duration(self.pace)} a generation")
        if self.seconds is not None:
            near = "less than a second to go" if self.seconds > 0 and self.limit else "about to end"
            parts.append(f"about {format_duration(self.seconds)} to go" if self.seconds >= 1 else near)
        elif self.limit is not None:
            parts += [f"about {format_duration(self.limit)} to its limit"] if self.limit >= 1 else []
            parts.append(f"then {plural(self.closing, 'episode')} of evaluation")
        return ", ".join(parts)


def estimate_eta(status: Status) -> Eta:
    """Estimate a run's end from its limits, its progress, the last generations' pace and the present workers' speed."""
    pace = _pace(status)
    next_seconds = _next_generation_seconds(status, pace)
    bounds = tuple(_counted_limits(status, pace, next_seconds))
    if next_seconds is not None:
        bounds = tuple(sorted(bounds, key=lambda each: math.inf if each.seconds is None else each.seconds))
    known = [0.0] if status.ending else [each.seconds for each in bounds if each.seconds is not None]
    limit = min(known) if known and status.state in ACTIVE_STATES and not _is_stalled(status, pace) else None
    closing = _closing_seconds(status)
    seconds = None if limit is None or closing is None else limit + closing
    return Eta(bounds, tuple(_uncounted_limits(status)), pace, limit, seconds, status.closing)


def describe_state(status: Status) -> str:
    """Describe what the run does now, or waits for; without its name."""
    detail = describe_detail(status)
    return f"{status.state}: {detail}" if detail and status.state in NAMED_STATES else detail or status.state


def describe_detail(status: Status) -> str:
    """The description of a state, without the state's own name; empty if that says all."""
    describe = STATE_DETAILS.get(status.state)
    return "" if describe is None else describe(status)


def summarise_status(status: Status) -> str:
    """Summarise a status in one line, for a log; without the run's name."""
    if status.is_over:
        return describe_state(status)
    opened, best = status.generation, in_values(status.confirmed or status.best, status.settings.task)
    score = "nothing evaluated yet" if best is None else f"best mean {format_mean(best)}"
    workers, slots = plural(status.workers.present, "worker"), plural(status.slots, "slot")
    lost, unit = describe_departed(status.workers), step_unit(status.settings.task.task)
    failed = status.failed + opened.failed
    failures = f", {plural(failed, 'failed candidate')}" if failed else ""
    return (
        f"{_summarise_progress(status)}{failures}, {score}, "
        f"{status.throughput.steps_per_second:,.0f} {unit}/s, {workers} with {slots}{f' ({lost})' if lost else ''}, "
        f"{estimate_eta(status).description}"
    )


def describe_departed(workers: WorkerCount) -> str:
    """The workers that went in the last minutes, such as "1 lost, 2 left"; empty if none did."""
    return ", ".join(f"{count} {how}" for how, count in (("lost", workers.lost), ("left", workers.left)) if count)


def format_duration(seconds: float) -> str:
    """Format a duration: 0.25 s, 4.6 s, 48 s, 12 min, 3 h 20 min, 5 d 2 h."""
    if not math.isfinite(seconds):
        return "very long"
    if seconds < 59.5:
        return f"{seconds:.2g} s" if seconds < 9.95 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    if hours < 48:
        return f"{hours} h {minutes} min" if minutes else f"{hours} h"
    days, hours = divmod(round(seconds / 3600), 24)
    return f"{days:,} d {hours} h" if hours else f"{days:,} d"


def _pace(status: Status) -> float | None:
    """Seconds a generation of late; `None` before the first is closed.

    That is the median of the last ones, which ignores a generation that was paused for hours, and a share of an
    evaluation. Each interval between evaluations has a generation that its evaluation makes longer. The interval's
    time beyond its own median is the evaluation's. Of the last three intervals the median counts, of two the smaller.
    One interval alone does not count: the run's first generation is often a long one.
    """
    recent, every = status.recent, max(status.settings.evaluate_every, 1)
    if not recent:
        return None
    pace = median(each.seconds for each in recent[-PACE_WINDOW:])
    intervals = [[each.seconds for each in group] for _, group in groupby(recent, lambda each: each.number // every)]
    beyond = [sum(each) - every * median(each) for each in intervals if len(each) == every][-3:]
    return pace + (max(median_low(beyond), 0.0) / every if len(beyond) > 1 else 0.0)


def _next_generation_seconds(status: Status, pace: float | None) -> float | None:
    """Seconds of a future generation: those of the last ones, or more if fewer workers are present now."""
    rate = status.throughput.episodes_per_second
    needed = status.generation.episodes / rate if rate else None
    return max((each for each in (pace, needed) if each is not None), default=None)


def _open_generation_seconds(status: Status, pace: float | None) -> float | None:
    """Seconds until the open generation closes, estimated likewise."""
    opened, rate = status.generation, status.throughput.episodes_per_second
    left = None if pace is None else max(pace - opened.seconds, 0.0)
    needed = max(opened.episodes - opened.episodes_done, 0) / rate if rate else None
    retries = (each.retry_in for each in status.failures if each.kind == "score")  # it cannot close before these
    return max((each for each in (left, needed, *retries) if each is not None), default=None)


def _closing_seconds(status: Status) -> float | None:
    """Seconds of the last evaluations and the confirmation; `None` if the speed of evaluations is unknown."""
    rate = status.throughput.evaluation_episodes_per_second
    return status.closing / rate if rate else None if status.closing else 0.0


def _counted_limits(status: Status, pace: float | None, next_seconds: float | None) -> Iterator[LimitProgress]:
    """Each countable limit. A run ends when a generation closes, so never before the open one does."""
    limits, spent, reached = status.limits, status.throughput, status.ending
    elapsed = 0.0 if reached else status.generation.seconds
    open_seconds = 0.0 if reached else _open_generation_seconds(status, pace)
    seconds: float | None
    if generations := _limit(limits, "generations"):
        closed = status.generations
        left = max(generations - closed, 0)
        seconds = None
        if next_seconds is not None and open_seconds is not None:
            seconds = (left - 1) * next_seconds + open_seconds if left else 0.0
        yield LimitProgress(
            "generations", closed, generations, seconds, f"{closed:,} of {plural(int(generations), 'generation')}"
        )
    if steps := _limit(limits, "steps"):
        done = spent.environment_steps
        rate = _closed_steps_per_second(status) * (pace / next_seconds if pace and next_seconds else 1.0)
        seconds = None
        if rate and open_seconds is not None:
            seconds = max((steps - done) / rate, open_seconds) if done < steps else open_seconds
        text = f"{format_steps(done)} of {format_steps(int(steps))} {step_unit(status.settings.task.task)}"
        yield LimitProgress("steps", done, steps, seconds, text)
    if minutes := _limit(limits, "minutes"):
        elapsed += spent.seconds
        text = f"{_format_minutes(elapsed / 60)} of {_format_minutes(minutes)} minute{'' if minutes == 1 else 's'}"
        yield LimitProgress("minutes", elapsed / 60, minutes, max(60 * minutes - elapsed, open_seconds or 0.0), text)


def _is_stalled(status: Status, pace: float | None) -> bool:
    """Whether the open generation is overdue and no step is made: an environment hangs, say."""
    is_overdue = pace is not None and status.generation.seconds > 2 * pace + STALL_SECONDS
    return is_overdue and status.state == "running" and not status.throughput.steps_per_second


def _closed_steps_per_second(status: Status) -> float:
    """Environment steps a second in the last closed generations."""
    recent = status.recent[-max(PACE_WINDOW, status.settings.evaluate_every) :]
    seconds = sum(each.seconds for each in recent)
    return sum(each.steps for each in recent) / seconds if seconds else 0.0


def _uncounted_limits(status: Status) -> Iterator[str]:
    """Describe the limits that depend on the results of evaluations."""
    target, parted = status.limits.get("target"), status.limits.get("parted")
    if isinstance(target, (int, float)):
        task = status.settings.task
        found = in_values(status.best, task)
        best = "" if found is None else f" (best {format_number(found.mean)})"
        yield f"until an evaluation reaches {value_of(target, task):zg}{best}"
    if isinstance(parted, int) and parted:
        yield f"until {plural(parted, 'evaluation')} in a row fall behind"


def _limit(limits: Mapping[str, Any], name: str) -> float:
    """A limit's value; 0 if it is not set, or not a number that this version understands."""
    found = limits.get(name)
    return found if isinstance(found, (int, float)) and 0 < found < math.inf else 0


def _format_minutes(value: float) -> str:
    """Format minutes: without decimals from ten on, else with one."""
    return f"{value:,.0f}" if value >= 10 or value == int(value) else f"{value:.1f}"


def _summarise_progress(status: Status) -> str:
    """The state, and the generation that is scored in it; near the run's end none is."""
    if status.state == "evaluating":
        return _describe_evaluating(status)
    if status.ending:
        return status.state
    opened = status.generation
    if status.settings.is_external and not opened.episodes:
        return status.state
    episodes = (
        f"{opened.episodes_done}/{plural(opened.episodes, 'episode')}" if opened.episodes else "all candidates failed"
    )
    return f"{status.state}, generation {opened.number} ({episodes})"


def _describe_running(status: Status) -> str:
    open_one = status.generation
    if not open_one.episodes:
        return f"generation {open_one.number}: all candidates failed"
    return f"generation {open_one.number}: {open_one.episodes_done:,} of {plural(open_one.episodes, 'episode')}"


def _describe_evaluating(status: Status) -> str:
    if status.confirming.episodes:
        return f"confirming its result: {_format_episodes(status.confirming)}"
    if status.evaluating.episodes:
        return f"waiting for an evaluation: {_format_episodes(status.evaluating)}"
    return "evaluating"


def _describe_waiting(status: Status) -> str:
    if status.refused:
        name, why = next(iter(status.refused.items()))
        return f"{name} was refused: {why}"
    known = status.workers.known
    if not known and not status.throughput.environment_steps:
        return "none has joined yet"
    left = sorted((each for each in status.worker_list if each.reason), key=lambda each: each.heard)
    last = f"; {left[0].worker} left {format_duration(left[0].heard)} ago: {left[0].reason}" if left else ""
    gone = describe_departed(status.workers)
    return f"none is present{f' ({gone})' if gone else ''}{last}"


def _format_episodes(part: EpisodeProgress) -> str:
    return f"{part.episodes_done:,} of {plural(part.episodes, 'episode')}"


def _describe_ended(status: Status) -> str:
    score = describe_score(in_values(status.confirmed or status.best, status.settings.task), status.score_word)
    return f"{status.why or 'stopped'}; {score}"


def _describe_left(status: Status) -> str:
    return (
        f"its coordinator left; `dreamfleet coordinator --resume {status.run}` continues (its log has the full command)"
    )


STATE_DETAILS: dict[str, Callable[[Status], str]] = {
    "running": _describe_running,
    "evaluating": _describe_evaluating,
    "waiting for workers": _describe_waiting,
    "paused": lambda status: status.why,
    "ended": _describe_ended,
    "left": _describe_left,
}
NAMED_STATES = ("waiting for workers", "paused", "ended")  # whose descriptions begin with their name
