"""The MDN-RNN: an LSTM that predicts the next latents as mixtures of Gaussians, and whether a reward comes.

Mixtures per latent dimension as in hardmaru/WorldModelsExperiments; the reward head as in the reward-predicting models
of its successors: the logit of a positive reward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional


@dataclass(frozen=True)
class MDNRNNConfig:
    """Sizes: `latent` + `actions` inputs, an LSTM of `hidden` units, `mixtures` Gaussians a latent dimension."""

    latent: int = 32
    actions: int = 3
    hidden: int = 256
    mixtures: int = 5


class Prediction(NamedTuple):
    """Of the next latents: log weights, means, log deviations `(..., latent, mixtures)`; reward logit `(...)`."""

    log_weights: Tensor
    means: Tensor
    log_deviations: Tensor
    reward: Tensor


class MDNRNN(nn.Module):
    """Latents and actions `(N, T, latent + actions)` to a prediction for each step."""

    def __init__(self, config: MDNRNNConfig) -> None:
        super().__init__()
        self.config = config
        self.lstm = nn.LSTM(config.latent + config.actions, config.hidden, batch_first=True)
        self.heads = nn.Linear(config.hidden, 3 * config.mixtures * config.latent + 1)

    def forward(self, inputs: Tensor) -> Prediction:
        """Predict from a zero state at the first step on."""
        hidden, _ = self.lstm(inputs)
        out = self.heads(hidden)
        shape = (*out.shape[:-1], self.config.latent, self.config.mixtures)
        weights, means, deviations = (part.reshape(shape) for part in out[..., :-1].chunk(3, dim=-1))
        return Prediction(functional.log_softmax(weights, dim=-1), means, deviations, out[..., -1])


def latent_loss(prediction: Prediction, targets: Tensor, mask: Tensor) -> Tensor:
    """Negative log likelihood in nats a latent dimension; `targets` `(N, T, latent)`, `mask` `(N, T)` 1 where real."""
    scaled = (targets[..., None] - prediction.means) * torch.exp(-prediction.log_deviations)
    log_normal = -0.5 * scaled.square() - prediction.log_deviations - 0.5 * math.log(2 * math.pi)
    likelihood = torch.logsumexp(prediction.log_weights + log_normal, dim=-1).mean(dim=-1)
    return -(likelihood * mask).sum() / mask.sum()


def reward_loss(prediction: Prediction, rewards: Tensor, mask: Tensor) -> Tensor:
    """Binary cross-entropy in nats of "this step's reward is positive"; `rewards` `(N, T)`."""
    losses = functional.binary_cross_entropy_with_logits(prediction.reward, (rewards > 0).float(), reduction="none")
    return (losses * mask).sum() / mask.sum()
