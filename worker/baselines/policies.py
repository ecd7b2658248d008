"""Baselines at the wheel: at random, or by the worth that the recurrent network gives each choice."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import FIVE_CHOICES, STEERING_GAS_BRAKE
from dreamfleet.worker.car_racing.frame_skip_policy import FrameSkipPolicy

if TYPE_CHECKING:
    from dreamfleet.worker.baselines.network import Memory, QNetwork

Floats = NDArray[np.float32]


class RandomPolicy:
    """Each step an action drawn evenly: of the whole range, or one of gymnasium's five."""

    def __init__(self, random: np.random.Generator, *, discrete: bool) -> None:
        self._random, self._discrete = random, discrete

    def begin(self, parameters: Floats) -> None:
        """Nothing is remembered."""

    def act(self, _observation: Any) -> Floats:
        """Steering, gas and brake `(3,)`."""
        if self._discrete:
            return np.array(self._random.choice(FIVE_CHOICES.choices), np.float32)
        return self._random.uniform(STEERING_GAS_BRAKE.low, STEERING_GAS_BRAKE.high).astype(np.float32)


class QPolicy(FrameSkipPolicy):
    """The choice of most worth, or with a chance of `epsilon` any: as it learns, on torch.

    The memory goes through time with each decision, also where chance decides; where it always does, nobody looks.
    """

    def __init__(self, network: QNetwork, epsilon: float = 0.0, random: np.random.Generator | None = None) -> None:
        """`random` is needed where `epsilon` is not 0."""
        super().__init__(network.config.table, network.config.frame_skip)
        self._network, self._epsilon, self._random = network, epsilon, random
        self._memory: Memory | None = None

    def reset_memory(self) -> None:
        """Nothing is remembered."""
        self._memory = None

    def choose(self, picture: NDArray[np.uint8]) -> int:
        """The best, or any."""
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
