"""The baselines' policies: random actions, or epsilon-greedy by the recurrent network's Q values."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import FIVE_CHOICES, STEERING_GAS_BRAKE
from dreamfleet.worker.tasks.frame_skip_policy import FrameSkipPolicy

if TYPE_CHECKING:
    from dreamfleet.worker.baselines.network import Memory, QNetwork

Floats = NDArray[np.float32]


class RandomPolicy:
    """Draws each action uniformly: from the whole range, or from gymnasium's five discrete ones."""

    def __init__(self, random: np.random.Generator, *, discrete: bool) -> None:
        self._random, self._discrete = random, discrete

    def begin(self, parameters: Floats) -> None:
        """Do nothing: it has no memory."""

    def act(self, _observation: Any) -> Floats:
        """Return steering, gas and brake `(3,)`."""
        if self._discrete:
            return np.array(self._random.choice(FIVE_CHOICES.choices), np.float32)
        return self._random.uniform(STEERING_GAS_BRAKE.low, STEERING_GAS_BRAKE.high).astype(np.float32)


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
