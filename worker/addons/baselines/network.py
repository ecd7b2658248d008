"""The recurrent duelling network: from pictures and the memory of earlier ones to a Q value of each choice."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dreamfleet.worker.addons.baselines.presets import AgentConfig
from dreamfleet.worker.tasks.policy import FrameSkipPolicy

Memory = tuple[Tensor, Tensor]
"""Hidden and cell state `(1, N, hidden)`."""


class QNetwork(nn.Module):
    """Convolutions, an LSTM, and the two streams of a duelling network: state value and advantages."""

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        self.config = config
        layers: list[nn.Module] = []
        for (before, after), kernel, stride in zip(config.channel_pairs, config.kernels, config.strides, strict=True):
            layers += [nn.Conv2d(before, after, kernel, stride), nn.ReLU()]
        self.look = nn.Sequential(*layers, nn.Flatten())
        self.lstm = nn.LSTM(config.flat, config.hidden, batch_first=True)
        self.value = nn.Linear(config.hidden, 1)
        self.advantage = nn.Linear(config.hidden, len(config.table))

    def features(self, pictures: Tensor) -> Tensor:
        """Convolve pictures `(N, T, side, side, 3)` uint8 into features `(N, T, flat)`."""
        rows, steps = pictures.shape[:2]
        flat: Tensor = self.look(pictures.flatten(0, 1).permute(0, 3, 1, 2).float() / 255)
        return flat.view(rows, steps, -1)

    def forward(self, features: Tensor, memory: Memory | None = None) -> tuple[Tensor, Memory]:
        """Map features `(N, T, flat)` to Q values `(N, T, choices)`, and the memory after the last step."""
        seen, memory = self.lstm(features, memory)
        advantage = self.advantage(seen)
        if self.config.heads == "softmax":
            advantage = advantage.softmax(dim=-1)
        return duelling(self.value(seen), advantage), memory

    def warm_up(self, features: Tensor, real: Tensor) -> Memory:
        """The memory after burn-in features `(N, B, flat)`, without gradients; zero while `real` (N, B) is 0."""
        zeros = torch.zeros(1, len(features), self.config.hidden, device=features.device)
        memory = zeros, zeros
        with torch.no_grad():
            for step in range(features.shape[1]):
                _, (hidden, cell) = self.lstm(features[:, step : step + 1], memory)
                memory = hidden * real[:, step, None], cell * real[:, step, None]
        return memory


class Networks(nn.Module):
    """The online network, which learns, and its target network: an earlier copy of it."""

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        self.config = config
        self.online = QNetwork(config)
        self.target = copy.deepcopy(self.online).requires_grad_(requires_grad=False)


def duelling(value: Tensor, advantage: Tensor) -> Tensor:
    """Wang et al. 2016 (arXiv:1511.06581), equation 9: Q(s, a) = V(s) + A(s, a) - mean over a of A(s, a).

    `value` is `(..., 1)`, `advantage` and the result are `(..., choices)`.
    """
    return value + advantage - advantage.mean(dim=-1, keepdim=True)


class QPolicy(FrameSkipPolicy):
    """Epsilon-greedy policy of the network while it learns.

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
        network = self._network
        with torch.no_grad():
            seen = torch.from_numpy(picture[None, None]).to(network.value.weight.device)
            worth, self._memory = network(network.features(seen), self._memory)
        return int(worth[0, 0].argmax())
