"""Training the MDN-RNN on encoded drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from common.errors import DatasetError
from common.progress import append_curve
from worker.training.checkpoint import load_checkpoint, load_progress, save_checkpoint
from worker.training.dataset import episodes, load, pad, split
from worker.training.encode import ENCODED, encoder_of
from worker.training.presets import TrainConfig
from worker.training.train_vae import Report
from worker.worldmodel.mdnrnn import (
    MDNRNN,
    REWARDED,
    MDNRNNConfig,
    binary_loss,
    latent_loss,
    reward_labels,
    reward_loss,
)

CHECKPOINT = "mdnrnn.safetensors"
SAVE_EVERY = 100
FLIP = np.array([-1, 1, 1], dtype=np.float32)  # a mirrored drive steers the other way


@dataclass(frozen=True)
class Drives:
    """A batch `(N, T, ...)` of drives, padded; `mask` `(N, T)` is 1 where a step is real."""

    mu: Tensor
    logvar: Tensor
    action: Tensor
    reward: Tensor
    done: Tensor
    mask: Tensor


def train_mdnrnn(
    folder: Path, config: TrainConfig, report: Report, layers: MDNRNNConfig = REWARDED
) -> dict[str, float]:
    """Train, or go on, to `config.updates`; returns the quality on held-out episodes."""
    train, held_out = split(episodes(folder, ENCODED))
    vae = encoder_of(folder)
    torch.manual_seed(config.seed)
    model = MDNRNN(layers)
    optimiser = torch.optim.Adam(model.parameters(), lr=config.rate)
    progress = load_checkpoint(folder / CHECKPOINT, model, optimiser) or {"update": 0, "vae": vae}
    if progress.get("vae") != vae:
        raise DatasetError(f"{folder / CHECKPOINT} was trained on latents of another VAE; delete it to begin anew")
    start: int = progress["update"]
    report(start, "")
    for update in range(start + 1, config.updates + 1):
        random = np.random.default_rng([config.seed, update])
        noise = torch.Generator().manual_seed(config.seed * 1_000_003 + update)
        chosen = random.choice(len(train), size=min(config.batch, len(train)), replace=False)
        drives = load_drives([train[index] for index in chosen], random.random(len(chosen)) < 0.5)
        parts = losses(model, drives, noise)
        optimiser.zero_grad()
        torch.stack(list(parts.values())).sum().backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip)
        optimiser.step()
        values = {name: part.item() for name, part in parts.items()}
        report(update, "  ".join(f"{name} {value:.3f}" for name, value in values.items()))
        if update % 10 == 0:
            append_curve(folder / "mdnrnn.jsonl", update=update, **values)
        if update % SAVE_EVERY == 0 or update == config.updates:
            save_checkpoint(folder / CHECKPOINT, model, optimiser, {"update": update, "vae": vae})
    return quality(model, held_out)


def vae_of(folder: Path) -> str:
    """Hash of the VAE checkpoint whose latents the folder's MDN-RNN was trained on."""
    return str(load_progress(folder / CHECKPOINT).get("vae"))


def losses(model: MDNRNN, drives: Drives, noise: torch.Generator) -> dict[str, Tensor]:
    """The loss of the latents and of each other head, in one pass; the latents are drawn anew from mu and logvar."""
    config = model.config
    sampled = drives.mu + torch.exp(0.5 * drives.logvar) * torch.randn(drives.mu.shape, generator=noise)
    prediction = model(inputs_of(config, sampled, drives))
    ahead = type(prediction)(*(part[:, :-1] for part in prediction))
    parts = {"latent": latent_loss(ahead, sampled[:, 1:], drives.mask[:, 1:])}
    if config.rewarded:
        labels = reward_labels(config.reward, drives.reward, drives.done)
        parts["reward"] = reward_loss(config.reward, prediction.reward, labels, drives.mask)
    if config.done:
        parts["done"] = binary_loss(prediction.done, drives.done, drives.mask)
    return parts


def inputs_of(config: MDNRNNConfig, latents: Tensor, drives: Drives) -> Tensor:
    """`(N, T, inputs)`: latents, actions, and where the model takes it the reward head's label of the step before."""
    parts = [latents, drives.action]
    if config.previous_reward:
        labels = reward_labels(config.reward, drives.reward, drives.done)
        parts.append(functional.pad(labels, (1, 0))[:, :-1, None])
    return torch.cat(parts, dim=-1)


def load_drives(paths: Sequence[Path], mirrored: NDArray[np.bool_]) -> Drives:
    """The drives of these episodes, some of them mirrored."""
    columns: dict[str, list[NDArray[np.float32]]] = {
        name: [] for name in ("mu", "logvar", "action", "reward", "done", "mask")
    }
    for path, flip in zip(paths, mirrored, strict=True):
        prefix = "mirrored_" if flip else ""
        arrays = load(path, f"{prefix}mu", f"{prefix}logvar", "action", "reward", "ended")
        columns["mu"].append(arrays[f"{prefix}mu"])
        columns["logvar"].append(arrays[f"{prefix}logvar"])
        columns["action"].append(arrays["action"] * (FLIP if flip else FLIP**2))
        columns["reward"].append(arrays["reward"])
        done = np.zeros(len(arrays["reward"]), dtype=np.float32)
        done[-1] = arrays["ended"]
        columns["done"].append(done)
        columns["mask"].append(np.ones(len(arrays["reward"]), dtype=np.float32))
    return Drives(**{name: torch.from_numpy(pad(arrays)) for name, arrays in columns.items()})


def quality(model: MDNRNN, held_out: Sequence[Path]) -> dict[str, float]:
    """Nats a latent dimension, and the area under the curve of the reward head, on held-out drives."""
    drives = load_drives(held_out, np.zeros(len(held_out), dtype=np.bool_))
    model.eval()
    with torch.no_grad():
        noise = torch.Generator().manual_seed(0)
        latent = losses(model, drives, noise)["latent"]
        prediction = model(inputs_of(model.config, drives.mu, drives))
    figures = {"nats_per_dimension": round(latent.item(), 3)}
    real = drives.mask.numpy() > 0
    if model.config.reward in ("positive", "notebook"):
        labels = reward_labels(model.config.reward, drives.reward, drives.done).numpy()[real] > 0
        figures["reward_auc"] = round(area_under_curve(prediction.reward.numpy()[real], labels), 3)
    return figures


def area_under_curve(scores: NDArray[np.float32], positive: NDArray[np.bool_]) -> float:
    """How often a positive scores above a negative; 0.5 is chance, NaN without both kinds."""
    ranks = np.empty(len(scores))
    ranks[np.argsort(scores)] = np.arange(1, len(scores) + 1)
    positives = int(positive.sum())
    pairs = positives * (len(scores) - positives)
    return float((ranks[positive].sum() - positives * (positives + 1) / 2) / pairs) if pairs else float("nan")
