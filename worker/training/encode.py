"""Recorded pictures as latents, once, so that the MDN-RNN trains on them many times; each drive also mirrored."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from common.bundle import hash_file
from common.errors import DatasetError
from common.files import write_aside
from worker.training.checkpoint import load_checkpoint, load_config
from worker.training.dataset import check_pictures, check_whole, episodes, load, load_pictures
from worker.training.train_vae import CHECKPOINT, as_tensor
from worker.worldmodel.vae import VAE
from worker.worldmodel.vae_config import VAEConfig

ENCODED = "encoded"


def encode(folder: Path) -> Iterator[int]:
    """Encode the episodes that are not encoded yet, and all when the VAE is another; yields the frames of each."""
    if not (folder / CHECKPOINT).exists():
        raise DatasetError(f"no {folder / CHECKPOINT}: run `dreamfleet train vae --data {folder}` first")
    model = VAE(load_config(folder / CHECKPOINT, VAEConfig))
    load_checkpoint(folder / CHECKPOINT, model, None)
    model.eval()
    vae = hash_file(folder / CHECKPOINT)
    check_whole(episodes(folder), "picture", "preprocessing", "action", "reward", "ended")
    check_pictures(episodes(folder), model.config.picture)
    for path in episodes(folder):
        target = folder / ENCODED / path.name
        if target.exists() and _is_of(target, vae):
            continue
        pictures = load_pictures(path)
        drive = load(path, "action", "reward", "ended")
        mu, logvar = _latents(model, pictures)
        mirrored_mu, mirrored_logvar = _latents(model, np.ascontiguousarray(pictures[:, :, ::-1]))
        with write_aside(target) as file:
            np.savez(
                file, mu=mu, logvar=logvar, mirrored_mu=mirrored_mu, mirrored_logvar=mirrored_logvar,
                action=drive["action"], reward=drive["reward"], ended=drive["ended"], vae=np.array(vae),
            )  # fmt: skip
        yield len(pictures)


def encoder_of(folder: Path) -> str:
    """Hash of the VAE checkpoint that a folder's latents come from; `DatasetError` if it is not the folder's own."""
    if not (folder / CHECKPOINT).exists():
        raise DatasetError(f"no {folder / CHECKPOINT}: run `dreamfleet train vae --data {folder}` first")
    vae = hash_file(folder / CHECKPOINT)
    for path in episodes(folder, ENCODED):
        if str(load(path, "vae")["vae"]) != vae:
            raise DatasetError(f"{path} is of another VAE: run `dreamfleet encode --data {folder}` again")
    return vae


def _is_of(target: Path, vae: str) -> bool:
    """Whether an encoded episode is whole, has what this version looks for, and comes from this VAE."""
    try:
        return str(load(target, "vae", "ended", "mu")["vae"]) == vae
    except DatasetError:
        return False


def _latents(model: VAE, pictures: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    with torch.no_grad():
        parts = [model.encode(as_tensor(pictures[start : start + 100])) for start in range(0, len(pictures), 100)]
    return torch.cat([mu for mu, _ in parts]).numpy(), torch.cat([logvar for _, logvar in parts]).numpy()
