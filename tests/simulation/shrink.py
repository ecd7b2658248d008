"""From a schedule that breaks a rule to a small one that breaks the same: what is left is what it takes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from tests.simulation.schedule import Fault, Schedule, Shape
from tests.simulation.world import Outcome, play

MAX_PLAYS = 600
# Features of a shape that the shrinker turns off, in this order.
PLAINER = (
    "failing", "on_failure", "first_score", "first_stage", "anew", "racing", "width", "parameters", "rollout",
    "collect_every", "confirm_episodes", "evaluate_every", "slots",
)  # fmt: skip
SMALLER = {"generations": 1, "workers": 1, "population": 2, "episodes": 1}


class Shrinker:
    """Tries smaller schedules and keeps those that break the same rule."""

    def __init__(self, failed: Outcome) -> None:
        assert failed.violation is not None
        self.best = failed
        self._rule = failed.violation.rule
        self._plays = 0

    def shrink(self) -> Outcome:
        """The smallest that was found: removing any one fault from it would make it harmless."""
        before = None
        while before is not self.best and self._plays < MAX_PLAYS:
            before = self.best
            self._drop_faults()
            self._simplify()
        return self.best

    def _drop_faults(self) -> None:
        """Leave out runs of faults, halves first, single ones last (delta debugging, Zeller 1999)."""
        size = len(self.best.schedule.faults)
        while size >= 1:
            start = 0
            while start < len(self.best.schedule.faults):
                if not self._try(self.best.schedule.without(start, start + size)):
                    start += size
            size //= 2

    def _simplify(self) -> None:
        """A plainer fleet, then shorter and weaker faults at rounder times."""
        for name in PLAINER:
            shape = self.best.schedule.shape
            self._try(replace(self.best.schedule, shape=replace(shape, **{name: getattr(Shape(), name)})))
        for name, least in SMALLER.items():
            shape = self.best.schedule.shape
            smaller = {name: max(getattr(shape, name) - 1, least)}
            self._try(replace(self.best.schedule, shape=replace(shape, **smaller)))
        for index in range(len(self.best.schedule.faults)):
            for fault in _weaker(self.best.schedule.faults[index]):
                faults = list(self.best.schedule.faults)
                faults[index] = fault
                self._try(replace(self.best.schedule, faults=tuple(faults)))

    def _try(self, schedule: Schedule) -> bool:
        if schedule == self.best.schedule or self._plays >= MAX_PLAYS:
            return False
        self._plays += 1
        outcome = play(schedule)
        smaller = outcome.violation is not None and outcome.violation.rule == self._rule
        if smaller:
            self.best = outcome
        return smaller


def _weaker(fault: Fault) -> Iterator[Fault]:
    yield replace(fault, at=round(fault.at, 1))
    yield replace(fault, seconds=round(fault.seconds / 2, 2))
    yield replace(fault, seconds=round(fault.seconds, 1), amount=round(fault.amount, 1))
    yield replace(fault, amount=round(fault.amount / 2, 2))
