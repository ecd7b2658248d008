"""A policy whose steps somebody watches; the episode stays the same.

The probe of a host's class hashes each snapshot: another field, order or dtype is another class for every host.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.tasks.api import Policy
from dreamfleet.worker.tasks.pictures import drawn_pixels
from dreamfleet.worker.tasks.watching import StepObserver, StepSnapshot

Picture = NDArray[np.uint8]


class WatchedPolicy:  # docs/how-to/watch.md
    """Wraps a policy and passes some of its steps to an observer; the actions are the policy's own."""

    def __init__(
        self, policy: Policy, observer: StepObserver, episode: int, render: Callable[[], Any] | None = None
    ) -> None:
        """`episode` is its index in the group; `render` draws the world where observations are not pictures."""
        self._policy, self._observer, self._episode, self._render = policy, observer, episode, render
        self._report_reward: Callable[[float], None] | None = getattr(policy, "reward", None)
        self._steps, self._score = 0, 0.0

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Start an episode with a controller's flat parameter vector."""
        self._policy.begin(parameters)
        self._steps, self._score = 0, 0.0

    def act(self, observation: Any) -> Any:
        """The policy's action."""
        if not self._observer.is_due():
            self._steps += 1
            return self._policy.act(observation)
        state = _copy_row(self._policy, "state")  # before it acts, so that a dream can continue from here
        action = self._policy.act(observation)

        def look() -> StepSnapshot:
            flat_action, latent = np.atleast_1d(np.asarray(action)), _copy_row(self._policy, "latent")
            return StepSnapshot(self._steps, self._score, flat_action, self._picture(observation), latent, state)

        self._observer.observe(self._episode, look)
        self._steps += 1
        return action

    def reward(self, value: float) -> None:
        """Add the reward of the last action, and pass it to the policy."""
        self._score += value
        if self._report_reward is not None:
            self._report_reward(value)

    def _picture(self, observation: Any) -> Picture | None:
        """The observation if it is a picture, or else what `render` draws; `None` if drawing fails."""
        if _is_picture(observation):
            return np.asarray(observation)
        drawn = None
        if self._render is not None:
            with suppress(Exception):
                drawn = drawn_pixels(self._render())
        return drawn


def _is_picture(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] == 3


def _copy_row(policy: Policy, name: str) -> NDArray[np.float32] | None:
    """A copy of the only row of the policy's attribute `name`; `None` if it is not such a float32 array."""
    found = getattr(policy, name, None)
    whole = isinstance(found, np.ndarray) and found.dtype == np.float32 and found.ndim == 2 and len(found) == 1
    return found[0].copy() if whole and found is not None else None
