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
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.worker.training.checkpoint import load_config, load_weights
from dreamfleet.worker.training.data.data_folder import explain_write_errors
from dreamfleet.worker.training.data.dataset import (
    check_pictures,
    check_whole,
    episode_paths,
    load_arrays,
    load_pictures,
    load_steps,
    preprocessing_of_size,
)
from dreamfleet.worker.training.train_vae import CHECKPOINT
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
    encode_pictures = _make_encoder(folder, config)
    vae, mirrors = encoder_hash(folder), encodes_mirrored(folder)
    check_whole(episode_paths(folder), "picture", "preprocessing", "action", "reward", "ended")
    check_pictures(episode_paths(folder), config.picture)
    for path in episode_paths(folder):
        target = folder / ENCODED / path.name
        if target.exists() and _is_current(target, vae):
            continue
        pictures = load_pictures(path)
        drive = load_steps(path)
        if len(drive["action"]) != len(pictures):
            raise DatasetError(f"{path} holds {len(pictures)} pictures and another number of actions; delete it")
        mu, logvar = encode_pictures(pictures)
        mirrored = dict[str, Any]()
        if mirrors:
            found = encode_pictures(np.ascontiguousarray(pictures[:, :, ::-1]))
            mirrored = dict(zip(("mirrored_mu", "mirrored_logvar"), found, strict=True))
        with explain_write_errors(target), atomic_write(target) as file:
            np.savez(
                file, mu=mu, logvar=logvar, **mirrored, action=drive["action"], reward=drive["reward"],
                ended=drive["ended"], vae=np.array(vae),
            )  # fmt: skip
        yield len(pictures)


def count_unencoded(folder: Path) -> int:
    """How many of a folder's drives have no latents yet."""
    drives, latents = ({path.name for path in (folder / kind).glob("[0-9]*.npz")} for kind in ("episodes", ENCODED))
    return len(drives - latents)


def latents_encoder_hash(folder: Path) -> str:
    """Hash of the encoder that a folder's latents come from; `DatasetError` if it is not the folder's own."""
    if not (folder / CHECKPOINT).exists():
        raise DatasetError(f"no {folder / CHECKPOINT}: run `dreamfleet train vae --data {folder}` first")
    vae = encoder_hash(folder)
    for path in episode_paths(folder, ENCODED):
        if str(load_arrays(path, "vae")["vae"]) != vae:
            raise DatasetError(f"{path} is of another VAE: run `dreamfleet encode --data {folder}` again")
    return vae


def encodes_mirrored(folder: Path) -> bool:
    """Whether a mirrored picture of the folder's VAE is one that a drive may show."""
    return preprocessing_of_size(load_config(folder / CHECKPOINT, VAEConfig).picture).mirrors


def encoder_hash(folder: Path) -> str:
    """SHA-256, hexadecimal, of the encoder's weights: a decoder may learn on, the latents stay."""
    hashed = hashlib.sha256()
    for name, array in sorted(load_weights(folder / CHECKPOINT).items()):
        if name.startswith(ENCODER):
            hashed.update(name.encode())
            hashed.update(array.tobytes())
    return hashed.hexdigest()


def _is_current(target: Path, vae: str) -> bool:
    """Whether an encoded episode is whole, has what this version looks for, and comes from this VAE."""
    try:
        return str(load_arrays(target, "vae", "ended", "mu")["vae"]) == vae
    except DatasetError:
        return False


def _make_encoder(folder: Path, config: VAEConfig) -> Callable[[NDArray[np.uint8]], Latents]:
    """From pictures `(T, side, side, 3)` to `mu` and `logvar` `(T, latent)`, on as many threads as torch would take."""
    graph = export_encoder(load_weights(folder / CHECKPOINT), config)
    session = open_graph(graph, torch.get_num_threads())

    def encode_pictures(pictures: NDArray[np.uint8]) -> Latents:
        starts = range(0, len(pictures), BATCH)
        parts = [session.run(["mu", "logvar"], {"picture": pictures[start : start + BATCH]}) for start in starts]
        mu, logvar = (np.concatenate(each) for each in zip(*parts, strict=True))
        return mu, logvar

    return encode_pictures
