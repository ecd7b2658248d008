"""The equations of the duelling double network, on tensors."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def duelling(value: Tensor, advantage: Tensor) -> Tensor:
    """Wang et al. 2016, equation 9: Q(s, a) = V(s) + A(s, a) - mean over a of A(s, a).

    `value` is `(..., 1)`, `advantage` and what comes back `(..., choices)`.
    """
    return value + advantage - advantage.mean(dim=-1, keepdim=True)


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
