"""What the demonstration does in each world: how long, how large, and what its words are."""

from __future__ import annotations

from dataclasses import dataclass, fields

from dreamfleet.common.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class DemoPlan:
    """A demonstration in one world: a run in the dream, and one in reality from the dream's best mean.

    In reality candidates have one episode each until a mean reaches `able_score`, for `quick_steps` at most: far from
    there more generations help more than more episodes, and large steps more than small ones.
    """

    bundle: str  # the world model, a shipped name or a file
    preset: str  # of the run in the dream
    dream_minutes: float
    minutes: float
    temperature: float
    population: int
    episodes: int
    horizon: int
    patience: int
    able_score: float
    quick_steps: int
    variant: str = ""  # of the run in reality: NAME=VALUE, or none
    word: str = "seed"  # a scored seed
    judge: str  # what the outcome is judged in
    video_steps: int
    random_score: float | None = None  # of random play
    packages: tuple[str, ...] = ()  # that the world needs beside the demonstration's own


FIRST_WORLD = "car-racing"
PLANS: dict[str, DemoPlan] = {
    FIRST_WORLD: DemoPlan(
        bundle="tiny",
        preset="dream",
        dream_minutes=0.5,
        minutes=4.5,
        temperature=1.5,
        population=24,
        episodes=4,
        horizon=1000,
        patience=100,
        able_score=800,
        quick_steps=700_000,
        # To drive on grass predicts losses that one track may not show.
        variant="offroad_cost=2",
        word="track",
        judge="gymnasium's own environment",
        video_steps=1000,
    ),
    # Not measured yet: no world model of it ships.
    "takecover": DemoPlan(
        bundle="takecover",
        preset="takecover",
        dream_minutes=3.0,
        minutes=1.5,
        temperature=1.15,
        population=24,
        episodes=4,
        horizon=525,
        patience=0,
        able_score=750,
        quick_steps=100_000,
        word="game",
        judge="the game, 4 tics a decision",
        video_steps=525,
        random_score=366,
        packages=("vizdoom",),
    ),
}


def find_plan(world: str) -> DemoPlan:
    """The plan of this world's demonstration; `UsageError` lists the worlds that have one.

    >>> find_plan("car-racing").word
    'track'
    """
    if world not in PLANS:
        raise UsageError(f"--world must be one of {', '.join(PLANS)}, not {world!r}")
    return PLANS[world]


def plan_defaults(name: str) -> str:
    """The value of one of a plan's fields in each world, for a help text."""
    assert name in {each.name for each in fields(DemoPlan)}
    return ", ".join(f"{getattr(plan, name)} in {world}" for world, plan in PLANS.items())
