"""Recorded pictures as latents, once, so that the MDN-RNN trains on them many times.

Each drive also mirrored, where its pictures show nothing that a mirrored drive would not show.
By the encoder as bundles carry it: the latents that controllers will see, to the bit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files import write_aside
from dreamfleet.worker.training.checkpoint import load_config, load_weights
from dreamfleet.worker.training.dataset import check_pictures, check_whole, episodes, load, load_pictures, load_steps
from dreamfleet.worker.training.room import told_where_full
from dreamfleet.worker.training.train_vae import CHECKPOINT
from dreamfleet.worker.training.world import preprocessing_to
from dreamfleet.worker.worldmodel.export import export_encoder
from dreamfleet.worker.worldmodel.inference import open_graph
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

ENCODED = "encoded"
BATCH = 100  # pictures
ENCODER = ("encoder.", "mu.", "logvar.")  # its weights, by name

Latents = tuple[NDArray[np.float32], NDArray[np.float32]]


def encode(folder: Path) -> Iterator[int]:
    """Encode the episodes that are not encoded yet, and all when the VAE is another; yields the frames of each."""
    if not (folder / CHECKPOINT).exists():
        raise DatasetError(f"no {folder / CHECKPOINT}: run `dreamfleet train vae --data {folder}` first")
    config = load_config(folder / CHECKPOINT, VAEConfig)
    look = _encoder(folder, config)
    vae, mirrors = identity(folder), mirrored_too(folder)
    check_whole(episodes(folder), "picture", "preprocessing", "action", "reward", "ended")
    check_pictures(episodes(folder), config.picture)
    for path in episodes(folder):
        target = folder / ENCODED / path.name
        if target.exists() and _is_of(target, vae):
            continue
        pictures = load_pictures(path)
        drive = load_steps(path)
        if len(drive["action"]) != len(pictures):
            raise DatasetError(f"{path} holds {len(pictures)} pictures and another number of actions; delete it")
        mu, logvar = look(pictures)
        mirrored = dict[str, Any]()
        if mirrors:
            found = look(np.ascontiguousarray(pictures[:, :, ::-1]))
            mirrored = dict(zip(("mirrored_mu", "mirrored_logvar"), found, strict=True))
        with told_where_full(target), write_aside(target) as file:
            np.savez(
                file, mu=mu, logvar=logvar, **mirrored, action=drive["action"], reward=drive["reward"],
                ended=drive["ended"], vae=np.array(vae),
            )  # fmt: skip
        yield len(pictures)


def unencoded(folder: Path) -> int:
    """How many of a folder's drives have no latents yet."""
    drives, latents = ({path.name for path in (folder / kind).glob("[0-9]*.npz")} for kind in ("episodes", ENCODED))
    return len(drives - latents)


def encoder_of(folder: Path) -> str:
    """Hash of the encoder that a folder's latents come from; `DatasetError` if it is not the folder's own."""
    if not (folder / CHECKPOINT).exists():
        raise DatasetError(f"no {folder / CHECKPOINT}: run `dreamfleet train vae --data {folder}` first")
    vae = identity(folder)
    for path in episodes(folder, ENCODED):
        if str(load(path, "vae")["vae"]) != vae:
            raise DatasetError(f"{path} is of another VAE: run `dreamfleet encode --data {folder}` again")
    return vae


def mirrored_too(folder: Path) -> bool:
    """Whether a mirrored picture of the folder's VAE is one that a drive may show."""
    return preprocessing_to(load_config(folder / CHECKPOINT, VAEConfig).picture).mirrors


def identity(folder: Path) -> str:
    """SHA-256, hexadecimal, of the encoder's weights: a decoder may learn on, the latents stay."""
    hashed = hashlib.sha256()
    for name, array in sorted(load_weights(folder / CHECKPOINT).items()):
        if name.startswith(ENCODER):
            hashed.update(name.encode())
            hashed.update(array.tobytes())
    return hashed.hexdigest()


def _is_of(target: Path, vae: str) -> bool:
    """Whether an encoded episode is whole, has what this version looks for, and comes from this VAE."""
    try:
        return str(load(target, "vae", "ended", "mu")["vae"]) == vae
    except DatasetError:
        return False


def _encoder(folder: Path, config: VAEConfig) -> Callable[[NDArray[np.uint8]], Latents]:
    """From pictures `(T, side, side, 3)` to `mu` and `logvar` `(T, latent)`, on as many threads as torch would take."""
    graph = export_encoder(load_weights(folder / CHECKPOINT), config)
    session = open_graph(graph, torch.get_num_threads())

    def look(pictures: NDArray[np.uint8]) -> Latents:
        starts = range(0, len(pictures), BATCH)
        parts = [session.run(["mu", "logvar"], {"picture": pictures[start : start + BATCH]}) for start in starts]
        mu, logvar = (np.concatenate(each) for each in zip(*parts, strict=True))
        return mu, logvar

    return look
