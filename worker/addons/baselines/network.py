"""The recurrent duelling double Q network: a Q value of each choice from pictures and memory, and its updates."""

import copy
import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.addons.baselines.presets import AgentConfig, LearningConfig
from dreamfleet.worker.addons.baselines.replay_buffer import TraceBatch
from dreamfleet.worker.tasks.model_free_policies import FrameSkipPolicy

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


class Learner:
    """The networks and their optimiser; every `target_every` updates the target becomes a copy of the online one."""

    def __init__(self, networks: Networks, optimiser: torch.optim.Adam, config: LearningConfig, updates: int) -> None:
        """`updates`: how many a resumed training has made already."""
        self._networks, self._optimiser, self._config = networks, optimiser, config
        self.updates = updates

    def learn(self, traces: TraceBatch) -> float:
        """Make one update and return its loss; `DatasetError` if that is NaN or infinite. The checkpoint stays."""
        loss = compute_loss(self._networks, traces, self._config)
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if not math.isfinite(value := loss.item()):
            raise DatasetError(
                f"the loss of update {self.updates + 1} is {value}: the rate is too high. The checkpoint of the last "
                "whole episode is kept, and the same command with a lower --rate continues from it"
            )
        if self._config.clip:
            torch.nn.utils.clip_grad_norm_(self._networks.online.parameters(), self._config.clip)
        self._optimiser.step()
        self.updates += 1
        if self.updates % self._config.target_every == 0:
            self._networks.target.load_state_dict(self._networks.online.state_dict())
        return value


def compute_loss(networks: Networks, traces: TraceBatch, config: LearningConfig) -> Tensor:
    """The loss of the online network's Q values of the chosen actions against their double-Q targets."""
    device = networks.online.value.weight.device
    of = {name: torch.from_numpy(array).to(device) for name, array in vars(traces).items()}
    online = q_values_along(networks.online, of["picture"], of["real"])
    with torch.no_grad():
        target = q_values_along(networks.target, of["picture"], of["real"])
        behind = slice(config.n_step, None)  # the states n decisions after each choice
        wanted = double_q_target(of["value"], of["discount"], online[:, behind], target[:, behind])
    predicted = online[:, : config.trace].gather(-1, of["choice"][..., None]).squeeze(-1)
    return masked_loss(predicted, wanted, of["mask"], config.loss)


def q_values_along(network: QNetwork, pictures: Tensor, real: Tensor) -> Tensor:
    """The Q values `(N, L + n, choices)` along traces, after their burn-in warmed the LSTM's memory."""
    burn_in = real.shape[1]
    with torch.no_grad():
        memory = network.warm_up(network.features(pictures[:, :burn_in]), real) if burn_in else None
    worth, _ = network(network.features(pictures[:, burn_in:]), memory)
    return torch.as_tensor(worth)


def double_q_target(returns: Tensor, discount: Tensor, online: Tensor, target: Tensor) -> Tensor:
    """Van Hasselt et al. 2016 (arXiv:1509.06461), equation 4: the online network chooses, the target network evaluates.

    `returns` and `discount` `(...)` are fields of `Returns`. `online` and `target` `(..., choices)` are the networks'
    Q values of the state after those rewards. At a terminal the discount is 0.
    """
    best = online.argmax(dim=-1, keepdim=True)
    return returns + discount * target.gather(-1, best).squeeze(-1)


def masked_loss(predicted: Tensor, target: Tensor, mask: Tensor, kind: str) -> Tensor:
    """The mean Huber loss (threshold 1) or squared error of `predicted` over the entries whose `mask` is 1."""
    each = functional.huber_loss if kind == "huber" else functional.mse_loss
    losses = each(predicted, target, reduction="none") * mask
    return losses.sum() / torch.clamp(mask.sum(), min=1)
