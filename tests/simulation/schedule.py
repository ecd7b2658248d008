"""What a play is made of: a small fleet, and faults at moments of the virtual clock. Plain data, from a number."""

from __future__ import annotations

import json
import random
from dataclasses import asdict, astuple, dataclass, replace
from functools import partial
from typing import Literal

SPAN = 9.0  # virtual seconds over which faults are spread: an undisturbed run takes about as long


@dataclass(frozen=True)
class Shape:
    """The fleet and the run that are disturbed."""

    workers: int = 2
    slots: int = 1  # of each worker
    width: int = 1  # jobs that a slot scores together
    generations: int = 2
    population: int = 3
    episodes: int = 2
    parameters: int = 4  # more than 10,240 are spread over several batches
    racing: bool = False
    first_stage: int = 0  # generations after which a second stage begins; 0: never
    first_score: float = 0.0  # of an evaluated mean, at which it begins earlier; 0: at none
    anew: bool = False  # whether the second stage begins the search anew
    evaluate_every: int = 0
    evaluation_episodes: int = 2
    confirm_episodes: int = 0  # with which the best evaluated means are confirmed as the run ends
    collect_every: int = 0
    rollout: int = 300  # bytes; more than 40,960 travel in several parts
    turn: float = 0.6  # virtual seconds that a slot's turn takes
    run_seed: int = 1
    verify: float = 0.0  # share of the results that another worker scores again
    on_failure: Literal["pause", "worst", "redraw"] = "pause"
    failing: float = 0.0  # share of a candidate's episodes that fail wherever they are scored
    ends: bool = True  # whether the run reaches its limit, or is paused after its last generation, and falls silent

    @property
    def most_jobs(self) -> int:
        """Of a generation; the second stage has a candidate and an episode more at most."""
        more = self.first_stage > 0
        return (self.population + more) * (self.episodes + more)


@dataclass(frozen=True)
class Fault:
    """One disturbance. The kind decides what `amount` means, see `faults.py`."""

    at: float
    kind: str
    worker: int
    seconds: float
    amount: float


# How often each kind comes, how many seconds it lasts, and the largest `amount` that is drawn.
KINDS: dict[str, tuple[int, float, float]] = {
    "lose_up": (4, 2.0, 0),
    "lose_down": (4, 2.0, 0),
    "double_up": (3, 2.0, 1.5),
    "double_down": (3, 2.0, 1.5),
    "delay_up": (3, 1.5, 4.0),
    "delay_down": (3, 1.5, 4.0),
    "jumble_up": (3, 2.0, 1.0),
    "jumble_down": (3, 2.0, 1.0),
    "cut": (4, 4.0, 1.0),
    "cut_unnoticed": (2, 4.0, 1.0),
    "lose_token": (2, 0.0, 1.0),
    "late_token": (1, 0.0, 4.0),
    "kill_worker": (4, 2.0, 0.3),
    "stop_worker": (3, 7.0, 0),
    "slow_worker": (2, 4.0, 9.0),
    "drain_worker": (1, 2.0, 0),
    "fail": (2, 0.0, 2.0),
    "kill_coordinator": (4, 1.5, 30.0),
    "kill_at_opening": (3, 1.5, 12.0),
    "stop_coordinator": (2, 6.0, 0),
    "leave": (1, 1.0, 0),
    "pause": (1, 2.0, 0),
    "stranger": (1, 0.0, 3.0),
    "garble": (1, 0.0, 3.0),
    "bar": (0, 4.0, 0),  # drawn apart, as the next one
    "resume": (0, 0.0, 0),
}


@dataclass(frozen=True)
class Schedule:
    """A play: the same one every time."""

    shape: Shape
    faults: tuple[Fault, ...]
    name: str = "by hand"

    def to_json(self) -> str:
        """One line, which `--replay` takes; only what differs from a default is written."""
        plain = Shape()
        shape = {key: value for key, value in asdict(self.shape).items() if value != getattr(plain, key)}
        return json.dumps({"name": self.name, "shape": shape, "faults": [astuple(fault) for fault in self.faults]})

    @classmethod
    def from_json(cls, text: str) -> Schedule:
        """What `to_json` wrote."""
        parsed = json.loads(text)
        return cls(Shape(**parsed["shape"]), tuple(Fault(*row) for row in parsed["faults"]), parsed["name"])

    def without(self, start: int, end: int) -> Schedule:
        """The same without some of its faults."""
        return replace(self, faults=self.faults[:start] + self.faults[end:])


def draw(seed: int, number: int) -> Schedule:
    """The schedule of this number in the campaign of this seed."""
    source = random.Random(f"{seed}/{number}")
    shape = _staged(_draw_shape(source), random.Random(f"stages of {seed}/{number}"))
    shape = replace(shape, verify=random.Random(f"checks of {seed}/{number}").choice((0.0, 0.0, 0.3, 1.0)))
    shape = _failing(shape, random.Random(f"failures of {seed}/{number}"))
    count = source.choice((0, 1, 5, 20, 20, 30, 40, 60))  # few faults too: each alone must be harmless
    kinds, weights = list(KINDS), [often for often, _, _ in KINDS.values()]
    faults = [_draw_fault(source, kind, shape.workers) for kind in source.choices(kinds, weights, k=count)]
    faults += _recalls(shape, random.Random(f"recalls of {seed}/{number}"))
    return Schedule(shape, tuple(sorted(faults, key=lambda fault: fault.at)), f"seed {seed}, schedule {number}")


def _staged(shape: Shape, source: random.Random) -> Shape:
    """One in eight has two stages; what else is drawn does not hang on it."""
    if source.random() > 0.125:
        return shape
    first, scored, anew = source.choice((1, 2, 3)), source.random() < 0.5, source.random() < 0.5
    at_score = {"first_score": 1.4, "evaluate_every": 1} if scored else {}
    return replace(shape, generations=3, first_stage=first, anew=anew, **at_score)


def _failing(shape: Shape, source: random.Random) -> Shape:
    """In one of six, episodes fail for good; what else is drawn does not hang on it."""
    policy, failing = source.choice(("worst", "redraw")), source.choice((0.05, 0.15))
    return shape if source.random() > 1 / 6 else replace(shape, on_failure=policy, failing=failing)


def _recalls(shape: Shape, source: random.Random) -> list[Fault]:
    """In half of the races and a few others, hosts are barred, and failures are tried again."""
    if source.random() > (0.5 if shape.racing else 0.05):
        return []
    kinds = source.choices(("bar", "resume"), k=source.choice((1, 2, 4)))
    return [_draw_fault(source, kind, shape.workers) for kind in kinds]


def _draw_fault(source: random.Random, kind: str, workers: int) -> Fault:
    _, longest, most = KINDS[kind]
    fraction = partial(source.uniform, 0.02, 1.0)
    return Fault(
        at=round(source.uniform(0.0, SPAN), 3),
        kind=kind,
        worker=source.randrange(workers),
        seconds=round(longest * fraction() ** 2, 3),  # short ones are the more frequent
        amount=round(most * fraction(), 3),
    )


def _draw_shape(source: random.Random) -> Shape:
    wide = source.random() < 0.1
    long = source.random() < 0.03
    return Shape(
        workers=source.choice((2, 2, 3, 4)),
        slots=source.choice((1, 1, 2)),
        width=256 if wide else 1,
        generations=source.choice((2, 2, 3)),
        population=12 if wide else source.choice((2, 3, 4)),
        episodes=2 if long else source.choice((1, 2, 3)),
        parameters=23_000 if long else 4,
        racing=source.random() < 0.15,
        evaluate_every=source.choice((0, 0, 1, 2)),
        confirm_episodes=source.choice((0, 0, 0, 4)),
        collect_every=source.choice((0, 0, 0, 2)),
        rollout=source.choice((300, 300, 90_000)),
        turn=source.choice((0.15, 0.5, 0.5, 1.2)),
        run_seed=source.randrange(4),
        ends=source.random() < 0.5,
    )
