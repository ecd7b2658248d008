"""Encoded rollouts as batches of an MDN-RNN, their labels, and the MDN-RNN's states along them. Pages: dreams.md."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.training.data.dataset import find_world, load_steps, pad, world_of_episode
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, reward_labels
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig

CHUNK_STEPS, CHUNK_ROWS = 10_000, 8  # at most in a chunk: about 300 MB in a model


@dataclass(frozen=True)
class Rollouts:
    """A batch `(N, T, ...)` of rollouts, padded; `mask` `(N, T)` is 1 where a step is real, `done` at a death."""

    mu: Tensor
    logvar: Tensor
    action: Tensor
    reward: Tensor
    done: Tensor
    mask: Tensor

    def chunks(self) -> Iterator[Rollouts]:
        """Yield the same rollouts in smaller batches of about equal lengths, so that few steps are padding."""
        lengths = self.mask.sum(dim=1).int()
        count = max(1, min(CHUNK_ROWS, CHUNK_STEPS // self.mask.shape[1]))
        for rows in torch.split(lengths.argsort(stable=True), count):
            yield Rollouts(*(getattr(self, each.name)[rows, : lengths[rows].max()] for each in fields(self)))

    def to(self, device: torch.device | None) -> Rollouts:
        """Copy to a device."""
        return Rollouts(*(getattr(self, each.name).to(device) for each in fields(self)))


def load_rollouts(paths: Sequence[Path], mirrored: NDArray[np.bool_] | None = None) -> Rollouts:
    """Load the rollouts of these episodes, mirrored where `mirrored` `(N,)` is true.

    `DatasetError` if one is to be mirrored whose world has no mirror, or actions have different sizes.
    """
    columns: dict[str, list[NDArray[np.float32]]] = {each.name: [] for each in fields(Rollouts)}
    for path, flip in zip(paths, np.zeros(len(paths), np.bool_) if mirrored is None else mirrored, strict=True):
        prefix = "mirrored_" if flip else ""
        arrays = load_steps(path, f"{prefix}mu", f"{prefix}logvar")
        columns["mu"].append(arrays[f"{prefix}mu"])
        columns["logvar"].append(arrays[f"{prefix}logvar"])
        columns["action"].append(_mirror(path, arrays["action"]) if flip else arrays["action"])
        columns["reward"].append(arrays["reward"])
        done = np.zeros(len(arrays["reward"]), dtype=np.float32)
        done[-1] = arrays["terminal"]
        columns["done"].append(done)
        columns["mask"].append(np.ones(len(arrays["reward"]), dtype=np.float32))
    return Rollouts(**{name: torch.from_numpy(pad(arrays)) for name, arrays in columns.items()})


def _mirror(path: Path, action: NDArray[np.float32]) -> NDArray[np.float32]:
    """The actions `(T, A)` of the mirrored drive."""
    world = world_of_episode(path)
    if (mirror := find_world(*world).world.mirror) is None:
        raise DatasetError(f"{path} has no mirrored drive: {world} has no mirror")
    return mirror.apply(action)


def done_labels(config: MDNRNNConfig, rollouts: Rollouts) -> Tensor:
    """The done head's targets `(N, T)`: 1 where an episode ended, or at least `lost` steps without reward follow.

    A drive that ends more than `lost` steps after its last reward counts as lost from that reward on.
    """
    if not config.lost:
        return rollouts.done
    paid = (rollouts.reward > 0) & (rollouts.mask > 0)
    count = paid.shape[1]
    steps = torch.arange(count, device=paid.device)
    never = torch.full_like(steps[:1], count).expand(len(paid), 1)
    following = torch.where(paid, steps, count).flip(1).cummin(dim=1).values.flip(1)
    next_paid = torch.cat([following[:, 1:], never], dim=1)
    last_paid = torch.where(paid, steps, -1).amax(dim=1, keepdim=True)
    given_up = rollouts.mask.sum(dim=1, keepdim=True) - 1 - last_paid > config.lost
    lost = torch.where(next_paid == count, given_up, next_paid - steps > config.lost)
    return torch.maximum(rollouts.done, lost * rollouts.mask)


def model_inputs(config: MDNRNNConfig, latents: Tensor, rollouts: Rollouts) -> Tensor:
    """The model's inputs `(N, T, inputs)`: latents, actions, and for some models the reward label of the step before.

    At the first step that label is `first_reward`.
    """
    parts = [latents, rollouts.action]
    if config.previous_reward:
        labels = reward_labels(config.reward, rollouts.reward, rollouts.done, config.reward_scale)
        parts.append(functional.pad(labels, (1, 0), value=config.first_reward)[:, :-1, None])
    return torch.cat(parts, dim=-1)


def teacher_force(model: MDNRNN, rollouts: Rollouts) -> tuple[Tensor, list[Tensor]]:
    """Run the model on recorded inputs: LSTM outputs `(N, T, hidden)`, and the state `(N, state)` before each step."""
    config = model.config
    labels = reward_labels(config.reward, rollouts.reward, rollouts.done, config.reward_scale)
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
    """Copy a state `(N, state)` with the reward label `(N,)` of the step before, for models that take it as input."""
    state = state.clone()
    state[:, 2 * model.config.hidden] = label
    return state
