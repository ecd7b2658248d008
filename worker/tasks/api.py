"""What a task is: an environment, and what a controller sees of it and may do.

The only module that a third party imports. Register a task under the entry-point group `dreamfleet.tasks`; the dream
and the real track satisfy the same protocol, so that no caller can tell them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.messages import TaskSpec

GROUP = "dreamfleet.tasks"


class Policy(Protocol):
    """A frozen world model under one controller."""

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode with this controller's flat vector."""

    def act(self, observation: Any) -> Any:
        """The environment's next action."""


class Rewarded(Protocol):
    """A policy that also wants to know what its actions bring; a policy need not."""

    def reward(self, value: float) -> None:
        """The reward of the last action, before the next one is asked for."""


@dataclass(frozen=True)
class Score:
    """An episode's outcome: fitness, and environment steps made."""

    fitness: float
    steps: int


Episode = tuple[NDArray[np.float32], int]
"""A candidate's flat vector and the seed of its episode."""


class Task(Protocol):
    """One thing to score in."""

    name: str
    width: int  # episodes that a slot scores at once

    def make_environment(self, bundle: Bundle) -> gymnasium.Env[Any, Any]:
        """A new environment; its observations are what the bundle's policy takes."""

    def make_judge(self, bundle: Bundle) -> gymnasium.Env[Any, Any]:
        """The environment that reported scores come from; the same as the other where there is no second one."""

    def make_policy(self, bundle: Bundle) -> Policy:
        """The policy of a bundle; `BundleError` if the bundle is of another task."""


class Batch(Protocol):
    """Scores many episodes together; each is the same bits alone."""

    def score(self, episodes: Sequence[Episode], on_step: Callable[[int], None]) -> list[Score]:
        """The score of each; `on_step` hears of all steps made so far."""


@runtime_checkable
class Batched(Protocol):
    """A task that scores candidates in batches, beside its environment, in which its means are evaluated."""

    def make_batch(self, bundle: Bundle, spec: TaskSpec) -> Batch:
        """What scores candidates; `BundleError` if the bundle has no such thing.

        Called again whenever `spec.temperature` changes, which a run with `--heat` raises.
        """


def known_tasks() -> tuple[str, ...]:
    """Names of the registered tasks."""
    return tuple(sorted(point.name for point in entry_points(group=GROUP)))


def find_task(name: str) -> Task:
    """A registered task by name, or any as `module:attribute`; `UsageError` lists the registered ones."""
    for point in entry_points(group=GROUP):
        if point.name == name:
            registered: Task = point.load()()
            return registered
    module, _, attribute = name.partition(":")
    if not attribute:
        raise UsageError(f"unknown task {name!r}: known are {', '.join(known_tasks()) or 'none'}")
    try:
        task: Task = getattr(import_module(module), attribute)()
    except (ImportError, AttributeError) as error:
        raise UsageError(f"task {name!r} cannot be loaded: {error}") from error
    return task
