"""A drive that somebody looks on at: the same drive, by a policy that shows some of its steps."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.tasks.api import Policy, StepObserver, StepSnapshot

Picture = NDArray[np.uint8]


class WatchedPolicy:
    """A policy whose steps an onlooker is shown when he is due one; its actions are the policy's own."""

    def __init__(
        self, policy: Policy, observer: StepObserver, episode: int, render: Callable[[], Any] | None = None
    ) -> None:
        """`episode` is its place in the turn; `render` gives the world's picture where what is observed is none."""
        self._policy, self._observer, self._episode, self._render = policy, observer, episode, render
        self._report_reward: Callable[[float], None] | None = getattr(policy, "reward", None)
        self._steps, self._score = 0, 0.0

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode with this controller's flat vector."""
        self._policy.begin(parameters)
        self._steps, self._score = 0, 0.0

    def act(self, observation: Any) -> Any:
        """The policy's action."""
        if not self._observer.due():
            self._steps += 1
            return self._policy.act(observation)
        state = _copy_row(self._policy, "state")  # before it acts: from here the world model may dream on
        action = self._policy.act(observation)

        def look() -> StepSnapshot:
            told = self._steps, self._score, np.atleast_1d(np.asarray(action))
            return StepSnapshot(*told, self._picture(observation), _copy_row(self._policy, "latent"), state)

        self._observer.see(self._episode, look)
        self._steps += 1
        return action

    def reward(self, value: float) -> None:
        """What the last action brought."""
        self._score += value
        if self._report_reward is not None:
            self._report_reward(value)

    def _picture(self, observation: Any) -> Picture | None:
        """What is observed, or drawn; a world that cannot draw itself is shown without, for no job fails by that."""
        if _is_picture(observation):
            return np.asarray(observation)
        drawn = None
        if self._render is not None:
            with suppress(Exception):
                drawn = self._render()
        return drawn if _is_picture(drawn) else None


def _is_picture(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] == 3


def _copy_row(policy: Policy, name: str) -> NDArray[np.float32] | None:
    """The only row of what a policy by a world model has under this name, a copy; `None` of one that has none."""
    found = getattr(policy, name, None)
    whole = isinstance(found, np.ndarray) and found.dtype == np.float32 and found.ndim == 2 and len(found) == 1
    return found[0].copy() if whole and found is not None else None
