"""How much is driven for a data set, and by whom; its fields are flags, so it is apart from what drives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.tasks.api import Policy, TaskWithPolicies
from dreamfleet.worker.tasks.policy import ALL_DRIVERS
from dreamfleet.worker.training.data.dataset import WORLD, find_world, preprocessing_of_size

MAX_NOISE = 10.0  # noise, in halves of an action's range


@dataclass(frozen=True)
class CollectConfig:
    """How much and what is driven."""

    episodes: int = option(400, "episodes in all")
    steps: int = option(300, "steps of an episode at most")
    seed: int = option(0, "makes the data set")
    anywhere: float = option(0.6, "share of episodes that start somewhere on the track instead of at its beginning")
    patience: int = option(120, "steps after the last new tile before an episode ends; 0: it goes on")
    picture: int = option(64, "height and width of what is recorded: 64, or 96 for the whole observation")
    noise: float = option(0.3, "on a controller's actions, of half their range; random drivers have none")
    spells: float = option(
        0.0, "chance of each step that an action which a controller leaves at its bound, as a brake, is tried"
    )
    driver: str = option(
        ALL_DRIVERS,
        f"who drives at random: {ALL_DRIVERS} (held, ornstein-uhlenbeck and random-walk in turn), one of these alone, "
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
    """The random policies that drive as those of a source do, by name; a world may have none."""
    task = find_world(world)
    return task.policies if isinstance(task, TaskWithPolicies) else {}


def known_drivers(world: str = WORLD) -> tuple[str, ...]:
    """Who may drive at random, by name."""
    return (*find_world(world).drivers, *source_policies(world))
