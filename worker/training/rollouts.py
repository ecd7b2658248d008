"""Encoded rollouts as batches of an MDN-RNN."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from dreamfleet.worker.training.dataset import load_steps, pad
from dreamfleet.worker.worldmodel.mdnrnn import reward_labels
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig

FLIP = np.array([-1, 1, 1], dtype=np.float32)  # a mirrored drive steers the other way
CHUNK_STEPS = 10_000  # that go through a model at once: about 300 MB


@dataclass(frozen=True)
class Rollouts:
    """A batch `(N, T, ...)` of rollouts, padded; `mask` `(N, T)` is 1 where a step is real, `done` where one ended."""

    mu: Tensor
    logvar: Tensor
    action: Tensor
    reward: Tensor
    done: Tensor
    mask: Tensor

    def chunks(self) -> Iterator[Rollouts]:
        """The same rollouts, few at a time."""
        rows = max(1, CHUNK_STEPS // self.mask.shape[1])
        for start in range(0, len(self.mask), rows):
            yield Rollouts(*(getattr(self, each.name)[start : start + rows] for each in fields(self)))

    def to(self, device: torch.device | None) -> Rollouts:
        """On a device."""
        return Rollouts(*(getattr(self, each.name).to(device) for each in fields(self)))


def load_rollouts(paths: Sequence[Path], mirrored: NDArray[np.bool_] | None = None) -> Rollouts:
    """The rollouts of these episodes, some of them mirrored."""
    columns: dict[str, list[NDArray[np.float32]]] = {each.name: [] for each in fields(Rollouts)}
    for path, flip in zip(paths, np.zeros(len(paths), np.bool_) if mirrored is None else mirrored, strict=True):
        prefix = "mirrored_" if flip else ""
        arrays = load_steps(path, f"{prefix}mu", f"{prefix}logvar")
        columns["mu"].append(arrays[f"{prefix}mu"])
        columns["logvar"].append(arrays[f"{prefix}logvar"])
        columns["action"].append(arrays["action"] * (FLIP if flip else FLIP**2))
        columns["reward"].append(arrays["reward"])
        done = np.zeros(len(arrays["reward"]), dtype=np.float32)
        done[-1] = arrays["ended"]
        columns["done"].append(done)
        columns["mask"].append(np.ones(len(arrays["reward"]), dtype=np.float32))
    return Rollouts(**{name: torch.from_numpy(pad(arrays)) for name, arrays in columns.items()})


def inputs_of(config: MDNRNNConfig, latents: Tensor, rollouts: Rollouts) -> Tensor:
    """`(N, T, inputs)`: latents, actions, and where the model takes it the reward head's label of the step before."""
    parts = [latents, rollouts.action]
    if config.previous_reward:
        labels = reward_labels(config.reward, rollouts.reward, rollouts.done)
        parts.append(functional.pad(labels, (1, 0))[:, :-1, None])
    return torch.cat(parts, dim=-1)
