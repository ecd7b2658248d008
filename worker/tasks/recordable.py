"""Optional: a task in whose world rollouts are recorded and world models are trained (docs/reference/worlds.md)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.tasks.api import Policy, Task
from dreamfleet.worker.tasks.model_free_policies import Driver
from dreamfleet.worker.tasks.world import World


@dataclass(frozen=True)
class Preprocessing:
    """A function from an environment's observation to the picture that a world model sees.

    >>> Preprocessing("half", size=48, picture=lambda picture: picture[::2, ::2]).shape
    (48, 48, 3)
    """

    name: str  # as bundles' manifests and recorded rollouts name it
    size: int  # height and width of its pictures
    picture: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]  # to `(size, size, 3)`, both uint8
    mirrors: bool = True  # whether a mirrored picture shows a drive with mirrored steering

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width and channels of its pictures."""
        return self.size, self.size, 3


@runtime_checkable
class RecordableTask(Protocol):
    """A task in whose world rollouts are recorded and world models are trained.

    Its `world` has `Continuous` actions. What `make_recorded` makes takes them as float32 vectors `(actions,)`, and
    observes uint8 `(size, size, 3)`. It says `terminated` where an episode ends by a death, `truncated` by a limit.
    """

    name: str

    @property
    def world(self) -> World:
        """The world."""

    @property
    def preprocessings(self) -> Mapping[str, Preprocessing]:
        """The kinds of pictures by name."""

    @property
    def drivers(self) -> Mapping[str, Callable[[np.random.Generator], Driver]]:
        """Random drivers by name, in the order in which collecting uses them in turn."""

    def make_recorded(self, preprocessing: str) -> gymnasium.Env[Any, Any]:
        """A new environment that observes the pictures of the preprocessing with this name."""


@runtime_checkable
class TaskWithBeginnings(Protocol):
    """Optional: a recordable task whose drives may also begin at random places in its world."""

    def begin_anywhere(self, environment: gymnasium.Env[Any, Any], random: np.random.Generator) -> Any:
        """Move a reset environment to a random place in its world; return the observation there."""


@runtime_checkable
class TaskWithOptions(Protocol):
    """Optional: a task that is recorded under options, such as a part of the picture. Data and bundles keep them."""

    def parse_options(self, arguments: Mapping[str, Any]) -> str:
        """Canonical JSON of the options that differ from their defaults, empty if none does; `UsageError` else."""

    def with_options(self, options: str) -> Task:
        """The task under these options, as `parse_options` writes them, or empty; a `RecordableTask`.

        It makes no environment: that would start a simulator. `UsageError` for options that it does not have.
        """


@runtime_checkable
class TaskWithPolicies(Protocol):
    """Optional: a task that also has random policies of published data sets."""

    policies: Mapping[str, Callable[[np.random.Generator], Policy]]
    """Random policies by name, each for one drive; each is used only if it is named."""
