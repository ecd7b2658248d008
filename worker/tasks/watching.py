"""Watching episodes while they are scored: what an observer gets of a step."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class StepSnapshot(NamedTuple):
    """One step of an episode for a live view, taken before its action is applied.

    `scoring/host_class_probe.py` hashes every field: another field is another class of every host.
    """

    step: int  # number of steps before it
    score: float  # sum of the rewards of those
    action: NDArray[Any]  # the action of this step
    picture: NDArray[np.uint8] | None = None  # (height, width, 3)
    latent: NDArray[np.float32] | None = None  # (latent,), of a world model
    state: NDArray[np.float32] | None = None  # (state,), the world model's before the action


class StepObserver(Protocol):
    """Receives some steps of episodes while they are scored. It changes no score."""

    def is_due(self) -> bool:
        """Whether to call `observe` for the present step; true for few steps."""

    def observe(self, episode: int, look: Callable[[], StepSnapshot]) -> None:
        """Receive a step of the episode with this index in its batch; `look()` makes the snapshot."""
