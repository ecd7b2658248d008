"""Training the MDN-RNN on encoded drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.errors import DatasetError
from common.progress import append_curve
from worker.training.checkpoint import load_checkpoint, save_checkpoint
from worker.training.dataset import episodes, load, pad, split
from worker.training.encode import ENCODED, encoder_of
from worker.training.presets import TrainConfig
from worker.training.train_vae import Report
from worker.worldmodel.mdnrnn import MDNRNN, MDNRNNConfig, latent_loss, reward_loss

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
    mask: Tensor


def train_mdnrnn(folder: Path, config: TrainConfig, report: Report) -> dict[str, float]:
    """Train, or go on, to `config.updates`; returns the quality on held-out episodes."""
    train, held_out = split(episodes(folder, ENCODED))
    vae = encoder_of(folder)
    torch.manual_seed(config.seed)
    model = MDNRNN(MDNRNNConfig())
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
        latent, reward = losses(model, drives, noise)
        optimiser.zero_grad()
        (latent + reward).backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip)
        optimiser.step()
        report(update, f"nats/dimension {latent.item():.3f}  reward {reward.item():.3f}")
        if update % 10 == 0:
            append_curve(folder / "mdnrnn.jsonl", update=update, latent=latent.item(), reward=reward.item())
        if update % SAVE_EVERY == 0 or update == config.updates:
            save_checkpoint(folder / CHECKPOINT, model, optimiser, {"update": update, "vae": vae})
    return quality(model, held_out)


def vae_of(folder: Path) -> str:
    """Hash of the VAE checkpoint whose latents the folder's MDN-RNN was trained on."""
    progress = load_checkpoint(folder / CHECKPOINT, MDNRNN(MDNRNNConfig()), None) or {}
    return str(progress.get("vae"))


def losses(model: MDNRNN, drives: Drives, noise: torch.Generator) -> tuple[Tensor, Tensor]:
    """Latent and reward loss of one pass; the latents are drawn anew from mu and logvar."""
    sampled = drives.mu + torch.exp(0.5 * drives.logvar) * torch.randn(drives.mu.shape, generator=noise)
    prediction = model(torch.cat([sampled, drives.action], dim=-1))
    ahead = type(prediction)(*(part[:, :-1] for part in prediction))
    return latent_loss(ahead, sampled[:, 1:], drives.mask[:, 1:]), reward_loss(prediction, drives.reward, drives.mask)


def load_drives(paths: Sequence[Path], mirrored: NDArray[np.bool_]) -> Drives:
    """The drives of these episodes, some of them mirrored."""
    columns: dict[str, list[NDArray[np.float32]]] = {"mu": [], "logvar": [], "action": [], "reward": [], "mask": []}
    for path, flip in zip(paths, mirrored, strict=True):
        prefix = "mirrored_" if flip else ""
        arrays = load(path, f"{prefix}mu", f"{prefix}logvar", "action", "reward")
        columns["mu"].append(arrays[f"{prefix}mu"])
        columns["logvar"].append(arrays[f"{prefix}logvar"])
        columns["action"].append(arrays["action"] * (FLIP if flip else FLIP**2))
        columns["reward"].append(arrays["reward"])
        columns["mask"].append(np.ones(len(arrays["reward"]), dtype=np.float32))
    return Drives(**{name: torch.from_numpy(pad(arrays)) for name, arrays in columns.items()})


def quality(model: MDNRNN, held_out: Sequence[Path]) -> dict[str, float]:
    """Nats a latent dimension, and the area under the curve of the reward head, on held-out drives."""
    drives = load_drives(held_out, np.zeros(len(held_out), dtype=np.bool_))
    model.eval()
    with torch.no_grad():
        noise = torch.Generator().manual_seed(0)
        latent, _ = losses(model, drives, noise)
        prediction = model(torch.cat([drives.mu, drives.action], dim=-1))
    real = drives.mask.numpy() > 0
    auc = area_under_curve(prediction.reward.numpy()[real], drives.reward.numpy()[real] > 0)
    return {"nats_per_dimension": round(latent.item(), 3), "reward_auc": round(auc, 3)}


def area_under_curve(scores: NDArray[np.float32], positive: NDArray[np.bool_]) -> float:
    """How often a positive scores above a negative; 0.5 is chance, NaN without both kinds."""
    ranks = np.empty(len(scores))
    ranks[np.argsort(scores)] = np.arange(1, len(scores) + 1)
    positives = int(positive.sum())
    pairs = positives * (len(scores) - positives)
    return float((ranks[positive].sum() - positives * (positives + 1) / 2) / pairs) if pairs else float("nan")
