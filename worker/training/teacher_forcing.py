"""The MDN-RNN along recorded drives: what it remembers before each of their steps."""

from __future__ import annotations

import torch
from torch import Tensor

from dreamfleet.worker.training.data.rollouts import Rollouts
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, reward_labels


def teacher_force(model: MDNRNN, rollouts: Rollouts) -> tuple[Tensor, list[Tensor]]:
    """What the LSTM gives at each step `(N, T, hidden)`, and the state `(N, state)` before each, from zero on."""
    config = model.config
    labels = reward_labels(config.reward, rollouts.reward, rollouts.done)
    state = rollouts.mu.new_zeros(len(rollouts.mu), config.state)
    states, hidden = [], []
    for step in range(rollouts.mu.shape[1]):
        if config.previous_reward:
            first = torch.full_like(labels[:, 0], config.first_reward)
            state = with_reward_label(model, state, labels[:, step - 1] if step else first)
        states.append(state)
        last, state = model.advance(torch.cat([rollouts.mu[:, step], rollouts.action[:, step]], dim=1), state)
        hidden.append(last)
    return torch.stack(hidden, dim=1), states


def with_reward_label(model: MDNRNN, state: Tensor, label: Tensor) -> Tensor:
    """A state `(N, state)` with the reward head's label `(N,)` of the step before; of models that look at it."""
    state = state.clone()
    state[:, 2 * model.config.hidden] = label
    return state
