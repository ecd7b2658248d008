"""Optional: a task whose worlds report their true state.

A run's measures may read it (`measures.py`) and are stored with each score, so its names and bits must stay.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import gymnasium

Truth = Callable[[gymnasium.Env[Any, Any]], dict[str, float]]
"""A function that reads the true state behind an environment's last observation."""


@runtime_checkable
class TaskWithTrueState(Protocol):  # docs/reference/worlds.md
    """A task whose worlds report their true state.

    `dreamfleet inspect` measures world models against it, and `dreamfleet evaluate` reports how a controller drove.

    >>> from dreamfleet.worker.tasks.registry import find_task
    >>> task = find_task("car-racing")
    >>> with task.make_recorded("box-64") as environment:
    ...     observation, info = environment.reset(seed=1)
    ...     task.truth(environment)["speed"]
    0.0
    """

    def truth(self, environment: gymnasium.Env[Any, Any]) -> dict[str, float]:
        """The true state behind the last observation, with the same names at every step.

        A world with a road names `off_road` (1 or 0) and `lateral_offset`, the distance from the road's middle; a world
        in which something drives names its `speed`.
        """
