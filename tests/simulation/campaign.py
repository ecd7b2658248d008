"""Many schedules in several processes: how many broke a rule, and what it takes to break it."""

from __future__ import annotations

import multiprocessing
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

from tests.simulation.schedule import draw
from tests.simulation.shrink import Shrinker
from tests.simulation.world import Outcome, play

CHUNK = 250  # schedules that a process plays before it reports
MAX_SHRUNK = 5  # violations that are cut down: more are counted


@dataclass
class Tally:
    """What a campaign, or a part of it, came to."""

    schedules: int = 0
    events: int = 0
    virtual: float = 0.0
    faults: Counter[str] = field(default_factory=Counter)
    failed: list[int] = field(default_factory=list)  # numbers of schedules

    def add(self, number: int, outcome: Outcome) -> None:
        """One play."""
        self.schedules += 1
        self.events += outcome.events
        self.virtual += outcome.now
        self.faults += outcome.happened
        self.failed += [] if outcome.violation is None else [number]

    def merge(self, other: Tally) -> None:
        """Another part."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    def __str__(self) -> str:
        return (
            f"{self.schedules} schedules, {self.faults.total()} faults, {self.events} events, "
            f"{self.virtual / 3600:.1f} virtual hours: {len(self.failed)} violations"
        )


def run(schedules: int, seed: int, jobs: int, first: int = 0) -> Tally:
    """Play so many schedules of this seed, from number `first` on."""
    whole, end = Tally(), first + schedules
    parts = [range(start, min(start + CHUNK, end)) for start in range(first, end, CHUNK)]
    for tally in _tallies(parts, seed, jobs):
        whole.merge(tally)
        if sys.stderr.isatty():
            print(f"\r{whole.schedules} schedules, {len(whole.failed)} violations", end="", file=sys.stderr)
    whole.failed.sort()
    return whole


def shrunk(tally: Tally, seed: int) -> Iterator[Outcome]:
    """The first violations of each rule, cut down to what it takes."""
    rules: Counter[str] = Counter()
    for number in tally.failed:
        outcome = play(draw(seed, number))
        assert outcome.violation is not None, "a schedule gave two plays"
        rules[outcome.violation.rule] += 1
        if rules[outcome.violation.rule] == 1 and len(rules) <= MAX_SHRUNK:
            yield Shrinker(outcome).shrink()


def _tallies(parts: list[range], seed: int, jobs: int) -> Iterator[Tally]:
    if jobs == 1:
        yield from map(partial(_play_part, seed), parts)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(partial(_play_part, seed), parts)


def _play_part(seed: int, part: range) -> Tally:
    tally = Tally()
    for number in part:
        tally.add(number, play(draw(seed, number)))
    return tally
