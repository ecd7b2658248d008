"""The driving of each world's controllers: variants of CarRacing, and what every other world has of these."""

from __future__ import annotations

from functools import lru_cache

from dreamfleet.common.artifacts.car_racing_variants import CAR_RACING, Variant
from dreamfleet.common.artifacts.task_options import read_options
from dreamfleet.common.artifacts.world_driving import Driving, WorldDriving
from dreamfleet.common.artifacts.world_facts import WorldFacts

__all__ = ["FIRST_WORLD", "Driving", "Variant", "WorldDriving", "parse_driving"]

FIRST_WORLD = CAR_RACING  # the default


def parse_driving(task: str, facts: WorldFacts, options: str) -> Driving:
    """How controllers of a world model drive under a run's options, a JSON object or an empty text.

    `task` and `facts` are of the world model's manifest; CarRacing has more options than other worlds. `UsageError` for
    options that the world does not have.

    >>> from dreamfleet import find_bundle
    >>> facts = find_bundle("tiny").manifest.world
    >>> driving = parse_driving("car-racing", facts, '{"pedals": "one", "feedback": "last"}')
    >>> driving.controls.outputs, driving.extra_features, driving.option_texts
    (2, 4, ('pedals=one', 'feedback=last'))
    """
    if task == CAR_RACING:
        return Variant.from_json(options)
    return _parse_options(task, facts, options)


@lru_cache
def _parse_options(task: str, facts: WorldFacts, options: str) -> WorldDriving:
    return WorldDriving(facts, **read_options(task, options, WorldDriving.HELP))
