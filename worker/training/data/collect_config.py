"""The configuration of collecting, whose fields are flags: amounts and drivers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from dreamfleet.common.cli.bounds import Positive, check_bounds
from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.messages import Share
from dreamfleet.common.schema.validation import Count
from dreamfleet.worker.scoring.rollout import DataWorld
from dreamfleet.worker.tasks.api import Policy
from dreamfleet.worker.tasks.model_free_policies import ALL_DRIVERS
from dreamfleet.worker.tasks.recordable import RecordableTask, TaskWithBeginnings, TaskWithPolicies
from dreamfleet.worker.training.data.dataset import find_world, preprocessing_of_size

Noise = Annotated[float, Meta(ge=0.0, le=10.0)]  # in halves of an action's range


@dataclass(frozen=True)
class CollectConfig:
    """How much is driven, how, and by which drivers. The numbers are of no world; `check_for` asks one for the rest."""

    episodes: Positive = option(400, "total number of episodes")
    steps: Positive = option(300, "longest episode, in steps")
    seed: Count = option(0, "random seed of the data set")
    anywhere: Share = option(0.6, "share of episodes that start at a random place in the world")
    patience: Count = option(120, "steps without a positive reward after which an episode ends; 0: never")
    picture: int = option(64, "height and width of recorded pictures: 64 or 96")
    noise: Noise = option(0.3, "noise on a controller's actions, in halves of their range; random drivers have none")
    spells: Share = option(
        0.0, "chance per step to try an action that a controller keeps at its bound, such as the brake, for a while"
    )
    driver: str = option(
        ALL_DRIVERS,
        f"random driver: {ALL_DRIVERS} (the world's drivers in turn), one of these alone, such as held, or a source's, "
        "such as uniform (the notebook's), pushed (the article's) or network (Ha & Schmidhuber's)",
    )

    def __post_init__(self) -> None:
        check_bounds(self)

    def check_for(self, world: DataWorld) -> None:
        """`UsageError` if the world has no such driver or pictures, or no random places to begin at."""
        preprocessing_of_size(self.picture, world)
        task = find_world(*world)
        if self.driver not in (known := (ALL_DRIVERS, *known_drivers(task))):
            raise UsageError(f"--driver must be one of {', '.join(known)}, not {self.driver!r}")
        if self.anywhere and not isinstance(task, TaskWithBeginnings):
            raise UsageError(f"drives of task {task.name} begin at no random place: give --anywhere 0")


def source_policies(task: RecordableTask) -> Mapping[str, Callable[[np.random.Generator], Policy]]:
    """The random policies of published sources by name; a world may have none."""
    return task.policies if isinstance(task, TaskWithPolicies) else {}


def known_drivers(task: RecordableTask | None = None) -> tuple[str, ...]:
    """The names of all random drivers of a task, by default that of the first world."""
    task = task or find_world()
    return (*task.drivers, *source_policies(task))
