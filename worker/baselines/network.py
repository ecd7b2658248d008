"""The recurrent duelling network: pictures and what was before them to a worth of each choice."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from dreamfleet.worker.baselines.agent_config import AgentConfig

Memory = tuple[Tensor, Tensor]
"""Hidden and cell state `(1, N, hidden)`."""


class QNetwork(nn.Module):
    """Convolutions, an LSTM through time, and two streams."""

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
        """Of pictures `(N, T, side, side, 3)` in bytes: `(N, T, flat)`."""
        rows, steps = pictures.shape[:2]
        flat: Tensor = self.look(pictures.flatten(0, 1).permute(0, 3, 1, 2).float() / 255)
        return flat.view(rows, steps, -1)

    def forward(self, features: Tensor, memory: Memory | None = None) -> tuple[Tensor, Memory]:
        """What each choice is worth `(N, T, choices)` along features `(N, T, flat)`, and the memory behind them."""
        seen, memory = self.lstm(features, memory)
        advantage = self.advantage(seen)
        if self.config.heads == "softmax":
            advantage = advantage.softmax(dim=-1)
        return duelling(self.value(seen), advantage), memory

    def warm_up(self, features: Tensor, real: Tensor) -> Memory:
        """The memory behind a burn-in `(N, B, flat)`, without gradients; zero until a row is `real` `(N, B)`."""
        memory = self.zero_memory(len(features), features.device)
        with torch.no_grad():
            for step in range(features.shape[1]):
                _, (hidden, cell) = self.lstm(features[:, step : step + 1], memory)
                memory = hidden * real[:, step, None], cell * real[:, step, None]
        return memory

    def zero_memory(self, rows: int, device: torch.device | None = None) -> Memory:
        """The memory as an episode begins."""
        zeros = torch.zeros(1, rows, self.config.hidden, device=device)
        return zeros, zeros


class Networks(nn.Module):
    """The network that learns, and its target: itself as it was a while ago."""

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        self.config = config
        self.online = QNetwork(config)
        self.target = copy.deepcopy(self.online).requires_grad_(requires_grad=False)

    def update_target(self) -> None:
        """Let the target be what the online network is."""
        self.target.load_state_dict(self.online.state_dict())


def duelling(value: Tensor, advantage: Tensor) -> Tensor:
    """Wang et al. 2016, equation 9: Q(s, a) = V(s) + A(s, a) - mean over a of A(s, a).

    `value` is `(..., 1)`, `advantage` and what comes back `(..., choices)`.
    """
    return value + advantage - advantage.mean(dim=-1, keepdim=True)
