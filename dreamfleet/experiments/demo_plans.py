"""What the demonstration does in each world that has one: how long, how large, and what its words are."""

from __future__ import annotations

from dataclasses import fields

from dreamfleet.common.errors import UsageError
from dreamfleet.common.worlds.profile import DemoPlan
from dreamfleet.common.worlds.shipped import WORLDS

PLANS: dict[str, DemoPlan] = {name: world.demo for name, world in WORLDS.items() if world.demo}


def find_plan(world: str) -> DemoPlan:
    """The plan of this world's demonstration; `UsageError` lists the worlds that have one.

    >>> find_plan("car-racing").bundle
    'tiny-int8'
    """
    if world not in PLANS:
        raise UsageError(f"--world must be one of {', '.join(PLANS)}, not {world!r}")
    return PLANS[world]


def plan_defaults(name: str) -> str:
    """The value of one of a plan's fields, or its values in each world where they differ, for a help text."""
    assert name in {each.name for each in fields(DemoPlan)}
    values = {world: f"{getattr(plan, name)}" for world, plan in PLANS.items()}
    if len(set(values.values())) == 1:
        return next(iter(values.values()))
    return ", ".join(f"{value} in {world}" for world, value in values.items())
