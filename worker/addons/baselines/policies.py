"""The baselines' policies: random actions, or epsilon-greedy by the recurrent network's Q values."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Actions, Discrete, one_hot
from dreamfleet.worker.tasks.drivers import UniformActions
from dreamfleet.worker.tasks.policy import FrameSkipPolicy

if TYPE_CHECKING:
    from dreamfleet.worker.addons.baselines.network import Memory, QNetwork

Floats = NDArray[np.float32]


class RandomPolicy:
    """Draws each action uniformly: one of its choices, or a number between the bounds of each component.

    >>> RandomPolicy(np.random.default_rng(1), Discrete(3, first=5)).act(None)
    np.int64(6)
    """

    def __init__(self, random: np.random.Generator, actions: Actions) -> None:
        self._driver = UniformActions(random, one_hot(actions.outputs) if isinstance(actions, Discrete) else actions)
        self._convert: Callable[[Floats], Any] = (
            actions.to_action if isinstance(actions, Discrete) else lambda drawn: drawn
        )

    def begin(self, parameters: Floats) -> None:
        """Do nothing: it has no memory."""

    def act(self, _observation: Any) -> Any:
        """Return an action as the environment's `step` takes it."""
        return self._convert(self._driver.act())


class QPolicy(FrameSkipPolicy):
    """Epsilon-greedy policy of the network while it learns, on torch.

    The LSTM's memory advances at each decision, random ones included. With `epsilon` 1 the network is not evaluated.
    """

    def __init__(self, network: QNetwork, epsilon: float = 0.0, random: np.random.Generator | None = None) -> None:
        """`random` is needed unless `epsilon` is 0."""
        super().__init__(network.config.table, network.config.frame_skip)
        self._network, self._epsilon, self._random = network, epsilon, random
        self._memory: Memory | None = None

    def reset_memory(self) -> None:
        """Forget the last episode."""
        self._memory = None

    def choose(self, picture: NDArray[np.uint8]) -> int:
        """Return the number of the best choice, or of a random one."""
        best = self._best(picture) if self._epsilon < 1 else 0
        if self._random is not None and self._random.random() < self._epsilon:
            return int(self._random.integers(len(self._network.config.table)))
        return best

    def _best(self, picture: NDArray[np.uint8]) -> int:
        import torch

        network = self._network
        with torch.no_grad():
            seen = torch.from_numpy(picture[None, None]).to(network.value.weight.device)
            worth, self._memory = network(network.features(seen), self._memory)
        return int(worth[0, 0].argmax())
