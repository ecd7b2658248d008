"""The configuration of collecting, whose fields are flags: amounts and drivers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.tasks.api import Policy, TaskWithPolicies
from dreamfleet.worker.tasks.policy import ALL_DRIVERS
from dreamfleet.worker.training.data.dataset import WORLD, find_world, preprocessing_of_size

MAX_NOISE = 10.0  # in halves of an action's range


@dataclass(frozen=True)
class CollectConfig:
    """How much is driven, how, and by which drivers."""

    episodes: int = option(400, "total number of episodes")
    steps: int = option(300, "longest episode, in steps")
    seed: int = option(0, "random seed of the data set")
    anywhere: float = option(0.6, "share of episodes that start at a random place on the track")
    patience: int = option(120, "steps without a new tile after which an episode ends; 0: never")
    picture: int = option(64, "height and width of recorded pictures: 64, or 96 for the whole observation")
    noise: float = option(0.3, "noise on a controller's actions, in halves of their range; random drivers have none")
    spells: float = option(
        0.0, "chance per step to try an action that a controller keeps at its bound, such as the brake, for a while"
    )
    driver: str = option(
        ALL_DRIVERS,
        f"random driver: {ALL_DRIVERS} (held, ornstein-uhlenbeck and random-walk in turn), one of these alone, "
        "uniform (the notebook's), pushed (the article's) or network (Ha & Schmidhuber's)",
    )

    def __post_init__(self) -> None:
        for name in ("episodes", "steps"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name} must be at least 1, not {getattr(self, name)}")
        if self.patience < 0:
            raise UsageError(f"--patience must be at least 1, or 0 for none, not {self.patience}")
        if not 0 <= self.anywhere <= 1:
            raise UsageError(f"--anywhere must be from 0 to 1, not {self.anywhere}")
        if self.driver not in (known := (ALL_DRIVERS, *known_drivers())):
            raise UsageError(f"--driver must be one of {', '.join(known)}, not {self.driver!r}")
        if self.seed < 0:
            raise UsageError(f"--seed must not be negative, not {self.seed}")
        if not 0 <= self.noise <= MAX_NOISE:
            raise UsageError(f"--noise must be from 0 to {MAX_NOISE:g}, not {self.noise}")
        if not 0 <= self.spells <= 1:
            raise UsageError(f"--spells must be from 0 to 1, not {self.spells}")
        preprocessing_of_size(self.picture)


def source_policies(world: str = WORLD) -> Mapping[str, Callable[[np.random.Generator], Policy]]:
    """The random policies of published sources by name; a world may have none."""
    task = find_world(world)
    return task.policies if isinstance(task, TaskWithPolicies) else {}


def known_drivers(world: str = WORLD) -> tuple[str, ...]:
    """The names of all random drivers."""
    return (*find_world(world).drivers, *source_policies(world))
