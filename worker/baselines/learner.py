"""One update of the recurrent duelling double network."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.baselines.learning_config import LearningConfig
from dreamfleet.worker.baselines.network import Networks, QNetwork
from dreamfleet.worker.baselines.replay_buffer import TraceBatch


class Learner:
    """Networks and their optimiser; the target follows every `target_every` updates."""

    def __init__(self, networks: Networks, optimiser: torch.optim.Adam, config: LearningConfig, updates: int) -> None:
        """`updates` that were made before."""
        self._networks, self._optimiser, self._config = networks, optimiser, config
        self.updates = updates

    def learn(self, traces: TraceBatch) -> float:
        """Make an update; its loss. `DatasetError` where that is no number: what was saved last is kept."""
        loss = compute_loss(self._networks, traces, self._config)
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if not math.isfinite(told := loss.item()):
            raise DatasetError(
                f"the loss of update {self.updates + 1} is {told}: the rate is too high; the checkpoint of the last "
                "whole episode is kept, and the same command with a lower --rate goes on from it"
            )
        if self._config.clip:
            torch.nn.utils.clip_grad_norm_(self._networks.online.parameters(), self._config.clip)
        self._optimiser.step()
        self.updates += 1
        if self.updates % self._config.target_every == 0:
            self._networks.update_target()
        return told


def compute_loss(networks: Networks, traces: TraceBatch, config: LearningConfig) -> Tensor:
    """How far the online network is from what is foretold behind each choice of the traces."""
    device = networks.online.value.weight.device
    of = {name: torch.from_numpy(array).to(device) for name, array in vars(traces).items()}
    online = q_values_along(networks.online, of["picture"], of["real"])
    with torch.no_grad():
        target = q_values_along(networks.target, of["picture"], of["real"])
        behind = slice(config.n_step, None)  # the moments behind the rewards of each choice
        wanted = double_q_target(of["value"], of["discount"], online[:, behind], target[:, behind])
    told = online[:, : config.trace].gather(-1, of["choice"][..., None]).squeeze(-1)
    return masked_loss(told, wanted, of["mask"], config.loss)


def q_values_along(network: QNetwork, pictures: Tensor, real: Tensor) -> Tensor:
    """What each choice is worth `(N, L + n, choices)` along traces, behind their burn-in."""
    burn_in = real.shape[1]
    with torch.no_grad():
        memory = network.warm_up(network.features(pictures[:, :burn_in]), real) if burn_in else None
    worth, _ = network(network.features(pictures[:, burn_in:]), memory)
    return torch.as_tensor(worth)


def double_q_target(returns: Tensor, discount: Tensor, online: Tensor, target: Tensor) -> Tensor:
    """Van Hasselt et al. 2016, equation 4: the online network chooses, the target network says what that is worth.

    `returns` and `discount` are `(...)`, as `Returns` has them; `online` and `target` `(..., choices)` are what the two
    networks tell of the moment behind the rewards. A discount of 0, at a terminal, adds nothing.
    """
    best = online.argmax(dim=-1, keepdim=True)
    return returns + discount * target.gather(-1, best).squeeze(-1)


def masked_loss(predicted: Tensor, target: Tensor, mask: Tensor, kind: str) -> Tensor:
    """The mean of Huber's loss (of a threshold of 1) or of the squared difference, where `mask` is 1."""
    each = functional.huber_loss if kind == "huber" else functional.mse_loss
    losses = each(predicted, target, reduction="none") * mask
    return losses.sum() / torch.clamp(mask.sum(), min=1)
