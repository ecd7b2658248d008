"""One gradient update of the recurrent duelling double Q network."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.addons.baselines.network import Networks, QNetwork
from dreamfleet.worker.addons.baselines.presets import LearningConfig
from dreamfleet.worker.addons.baselines.replay_buffer import TraceBatch


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
