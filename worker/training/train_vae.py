"""Training the VAE on recorded pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from common.progress import append_curve
from worker.training.checkpoint import load_checkpoint, save_checkpoint
from worker.training.dataset import episodes, load_pictures, picture_batches, split
from worker.training.presets import TrainConfig
from worker.worldmodel.vae import PAPER, VAE, VAEConfig

CHECKPOINT = "vae.safetensors"
SAVE_EVERY = 200
VALIDATION_PICTURES = 2000
ACTIVE_NATS = 0.1  # a picture, on average over the held-out ones, above which a latent carries something

Report = Callable[[int, str], None]


def train_vae(folder: Path, config: TrainConfig, report: Report, layers: VAEConfig = PAPER) -> dict[str, float]:
    """Train, or go on, to `config.updates`; returns the quality on held-out episodes."""
    train, held_out = split(episodes(folder))
    torch.manual_seed(config.seed)
    model = VAE(layers)
    optimiser = torch.optim.Adam(model.parameters(), lr=config.rate)
    progress = load_checkpoint(folder / CHECKPOINT, model, optimiser) or {"update": 0, "pool": 0}
    update: int = progress["update"]
    report(update, "")
    noise = torch.Generator().manual_seed(config.seed + update)
    for pool, batch in picture_batches(train, config.batch, config.seed, progress["pool"]):
        if update >= config.updates:
            break
        loss, error, divergence = model.loss(
            as_tensor(batch), torch.randn(len(batch), model.config.latent, generator=noise)
        )
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        update += 1
        report(update, f"error {error.item():.1f}  KL {divergence.item():.1f}")
        if update % 20 == 0:
            append_curve(folder / "vae.jsonl", update=update, error=error.item(), kl=divergence.item())
        if update % SAVE_EVERY == 0 or update == config.updates:
            save_checkpoint(folder / CHECKPOINT, model, optimiser, {"update": update, "pool": pool + 1})
    return quality(model, held_out)


def quality(model: VAE, held_out: Sequence[Path]) -> dict[str, float]:
    """Summed squared error a picture, beside that of the mean picture, and how many latents are active."""
    pictures = np.concatenate([load_pictures(path)[::5] for path in held_out])[:VALIDATION_PICTURES]
    mean = pictures.astype(np.float32).mean(axis=0) / 255
    errors, baseline, nats = [], [], []
    model.eval()
    with torch.no_grad():
        for start in range(0, len(pictures), 100):
            batch = as_tensor(pictures[start : start + 100])
            mu, logvar = model.encode(batch)
            errors.append((model.decode(mu) - batch).square().sum(dim=(1, 2, 3)).numpy())
            baseline.append(((pictures[start : start + 100] / 255.0 - mean) ** 2).sum(axis=(1, 2, 3)))
            nats.append((0.5 * (mu.square() + logvar.exp() - logvar - 1)).numpy())
    active = (np.concatenate(nats).mean(axis=0) > ACTIVE_NATS).sum()
    return {
        "reconstruction_error": round(float(np.concatenate(errors).mean()), 2),
        "mean_picture_error": round(float(np.concatenate(baseline).mean()), 2),
        "active_latents": int(active),
    }


def as_tensor(pictures: NDArray[np.uint8]) -> torch.Tensor:
    """Pictures `(N, 64, 64, 3)` uint8 as `(N, 3, 64, 64)` in [0, 1]."""
    return torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 255
