"""How far a run is on the way to its real end, and how long the rest takes, by its status. No input or output."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from statistics import median, median_low
from typing import Any

from dreamfleet.common.client.status import Status
from dreamfleet.common.printable import format_duration, format_number, plural
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.tasks import step_unit
from dreamfleet.common.runs.effort import format_steps
from dreamfleet.common.runs.records import in_values

PACE_WINDOW = 10  # closed generations that tell the pace (docs/reference/metrics.md)
SLOWER = 1.5  # times the pace that the present workers need, from which on they set it: less is noise of episodes
STALL_SECONDS = 60.0  # how long a generation that is overdue makes no step until its end is unknown
ACTIVE_STATES = ("running", "evaluating")
SEARCH, DONE = "search", "search done"


@dataclass(frozen=True)
class Limit:
    """A countable limit of a run's search."""

    name: str  # generations, steps, minutes
    share: float  # done, from 0 to 1
    seconds: float | None  # until it is reached at the present pace; `None` if that is not known yet
    description: str  # "18 of 30 minutes"


@dataclass(frozen=True)
class Rest:
    """What is left of one part of a run: of its search, its last evaluations or its confirmation."""

    name: str
    seconds: float | None  # `None` if unknown
    episodes: int = 0  # of evaluations and confirmation

    @property
    def description(self) -> str:
        """A text such as "search 4 min" or "confirmation 90 episodes"."""
        left = plural(self.episodes, "episode") if self.seconds is None else format_duration(self.seconds)
        return f"{self.name} {left}"


@dataclass(frozen=True)
class Eta:
    """The estimated end of a run, in parts: search until its first limit, last evaluations, confirmation."""

    limits: tuple[Limit, ...]  # countable ones, the nearest first; none once the search is done
    others: tuple[str, ...]  # limits whose time cannot be estimated, in words
    pace: float | None  # seconds a future generation; `None` before the first is closed
    share: float | None  # of the time to the end that is over, from 0 to 1; `None` if no end is known
    rest: tuple[Rest, ...]  # the parts that are left; none while nobody scores or nothing moves

    @property
    def seconds(self) -> float | None:
        """Seconds until the run's end; `None` if that is not known."""
        return _total(self.rest)

    @property
    def description(self) -> str:
        """A text such as "18 of 30 minutes, about 16 min to go: search 12 min, evaluation 4 min"."""
        parts = [*(each.description for each in self.limits), *self.others]
        if self.pace is not None and parts != [DONE]:
            parts.append(f"{format_duration(self.pace)} a generation")
        if self.rest:
            one = len(self.rest) == 1 and self.seconds is not None  # its seconds are the whole
            left = self.rest[0].name if one else ", ".join(each.description for each in self.rest)
            named = f": {left}" if [each.name for each in self.rest] != [SEARCH] else ""
            about = f"about {format_duration(self.seconds)} to go" if self.seconds else "about to end"
            parts.append(f"to go{named}" if self.seconds is None else f"{about}{named}")
        return ", ".join(parts)


def estimate_eta(status: Status) -> Eta:
    """Estimate a run's end from its limits, its progress, the last generations' pace and the present workers' speed."""
    judging, pace = tuple(_rest_of_judging(status)), _pace(status)
    if status.ending:
        return Eta((), (DONE,), pace, _share(status, (), judging), judging if status.state in ACTIVE_STATES else ())
    next_seconds = _next_generation_seconds(status, pace)
    limits = tuple(_counted_limits(status, pace, next_seconds))
    if next_seconds is not None:
        limits = tuple(sorted(limits, key=lambda each: math.inf if each.seconds is None else each.seconds))
    shown = None if pace is None else next_seconds
    nearest = min((each.seconds for each in limits if each.seconds is not None), default=None)
    rest = () if nearest is None else (Rest(SEARCH, nearest), *judging)
    others = tuple(_uncounted_limits(status))
    if not limits and not others:
        others = ("no limit: it runs until it is stopped",)
    return Eta(limits, others, shown, _share(status, limits, rest), rest if _moves(status, pace) else ())


def _total(rest: tuple[Rest, ...]) -> float | None:
    """Seconds of all parts; `None` without parts, and if those of one are unknown."""
    known = [each.seconds for each in rest if each.seconds is not None]
    return sum(known) if known and len(known) == len(rest) else None


def _rest_of_judging(status: Status) -> Iterator[Rest]:
    """The evaluations and the confirmation that are left after the search."""
    rate, settings, now = status.throughput.evaluation_episodes_per_second, status.settings, status.evaluating
    last = 0 if status.ending or not settings.evaluate_every else settings.evaluation_episodes
    evaluation = min(max(now.episodes - now.episodes_done, 0) + last, status.closing)
    for name, episodes in (("evaluation", evaluation), ("confirmation", status.closing - evaluation)):
        if episodes:
            yield Rest(name, episodes / rate if rate else None, episodes)


def _share(status: Status, limits: tuple[Limit, ...], rest: tuple[Rest, ...]) -> float | None:
    """The share of the time to the end that is over; of episodes, or of the search, where the time is unknown."""
    judged = status.ending * (status.evaluating.episodes_done + status.confirming.episodes_done)
    rate, seconds = status.throughput.evaluation_episodes_per_second, _total(rest)
    if seconds is not None:
        done = status.throughput.seconds + (judged / rate if rate else 0.0)
        done += 0.0 if status.ending else status.generation.seconds
        return done / (done + seconds) if done + seconds else None
    if status.ending:
        return judged / (judged + status.closing) if status.closing else 1.0
    return limits[0].share if limits else None


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
    """Seconds of a future generation: those of the last ones, or more if clearly fewer workers are present now."""
    rate = status.throughput.episodes_per_second
    needed = status.generation.episodes / rate if rate else None
    return needed if pace is None or (needed is not None and needed > SLOWER * pace) else pace


def _open_generation_seconds(status: Status, pace: float | None) -> float | None:
    """Seconds until the open generation closes, estimated likewise."""
    opened, rate = status.generation, status.throughput.episodes_per_second
    left = None if pace is None else max(pace - opened.seconds, 0.0)
    needed = max(opened.episodes - opened.episodes_done, 0) / rate if rate else None
    retries = (each.retry_in for each in status.failures if each.kind == "score")  # it cannot close before these
    return max((each for each in (left, needed, *retries) if each is not None), default=None)


def _counted_limits(status: Status, pace: float | None, next_seconds: float | None) -> Iterator[Limit]:
    """Each countable limit. A run ends when a generation closes, so never before the open one does."""
    spent, open_seconds = status.throughput, _open_generation_seconds(status, pace)
    seconds: float | None
    if generations := _limit(status.limits, "generations"):
        left, seconds = max(generations - status.generations, 0.0), None
        if next_seconds is not None and open_seconds is not None:
            seconds = (left - 1) * next_seconds + open_seconds if left else 0.0
        text = f"{status.generations:,} of {plural(int(generations), 'generation')}"
        yield Limit("generations", min(status.generations / generations, 1.0), seconds, text)
    if steps := _limit(status.limits, "steps"):
        done, seconds = spent.environment_steps, None
        rate = _closed_steps_per_second(status) * (pace / next_seconds if pace and next_seconds else 1.0)
        if rate and open_seconds is not None:
            seconds = max((steps - done) / rate, open_seconds) if done < steps else open_seconds
        text = f"{format_steps(done)} of {format_steps(int(steps))} {step_unit(status.settings.task.task)}"
        yield Limit("steps", min(done / steps, 1.0), seconds, text)
    if minutes := _limit(status.limits, "minutes"):
        elapsed = (spent.seconds + status.generation.seconds) / 60
        text = f"{_format_minutes(min(elapsed, minutes))} of {_format_minutes(minutes)} minute{'s' * (minutes != 1)}"
        yield Limit("minutes", min(elapsed / minutes, 1.0), max(60 * (minutes - elapsed), open_seconds or 0.0), text)


def _moves(status: Status, pace: float | None) -> bool:
    """Whether somebody scores. A generation that is overdue without a step does not move: an environment hangs, say."""
    is_overdue = pace is not None and status.generation.seconds > 2 * pace + STALL_SECONDS
    is_stalled = is_overdue and status.state == "running" and not status.throughput.steps_per_second
    return status.state in ACTIVE_STATES and not is_stalled


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
