"""Encode recorded pictures to latents once, because the MDN-RNN trains on them many times.

Each drive is also encoded mirrored, if mirrored pictures can occur in a drive. The encoder is the bundle's ONNX graph,
so the latents equal those that controllers will see, to the bit.
"""

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.printable import plural
from dreamfleet.worker.training.checkpoint import load_config, load_weights
from dreamfleet.worker.training.data import dataset
from dreamfleet.worker.training.data.data_folder import explain_write_errors
from dreamfleet.worker.training.train_vae import CHECKPOINT
from dreamfleet.worker.worldmodel.export import export_encoder
from dreamfleet.worker.worldmodel.inference import open_graph
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

ENCODED = "encoded"  # counts alike: dreamfleet/experiments/iteration/layout.py
BATCH = 100  # pictures
ENCODER = ("encoder.", "mu.", "logvar.")  # prefixes of its weights' names

Latents = tuple[NDArray[np.float32], NDArray[np.float32]]


def encode(folder: Path) -> Iterator[int]:
    """Encode the episodes without latents of this VAE; yield the number of frames of each."""
    config = load_config(folder / CHECKPOINT, VAEConfig)
    encode_pictures = _make_encoder(folder, config)
    vae, mirrors = encoder_hash(folder), encodes_mirrored(folder)
    dataset.check_whole(dataset.episode_paths(folder), "picture", "preprocessing", "world", "action", "reward", "ended")
    dataset.check_pictures(dataset.episode_paths(folder), config.picture)
    for path in dataset.episode_paths(folder):
        target = folder / ENCODED / path.name
        if target.exists() and _is_current(target, vae):
            continue
        pictures = dataset.load_pictures(path)
        drive = dataset.load_steps(path)
        if len(drive["action"]) != len(pictures):
            raise DatasetError(
                f"{path} holds {plural(len(pictures), 'picture')} and another number of actions; delete it"
            )
        mu, logvar = encode_pictures(pictures)
        more: dict[str, Any] = dataset.load_arrays(path, "world", optional=("terminal",))
        if mirrors:
            found = encode_pictures(np.ascontiguousarray(pictures[:, :, ::-1]))
            more |= zip(("mirrored_mu", "mirrored_logvar"), found, strict=True)
        with explain_write_errors(target), atomic_write(target) as file:
            np.savez(
                file, mu=mu, logvar=logvar, **more, action=drive["action"], reward=drive["reward"],
                ended=drive["ended"], vae=np.array(vae),
            )  # fmt: skip
        yield len(pictures)


def count_unencoded(folder: Path) -> int:
    """The number of a folder's drives without latents."""
    drives, latents = ({path.name for path in (folder / kind).glob("[0-9]*.npz")} for kind in ("episodes", ENCODED))
    return len(drives - latents)


def latents_encoder_hash(folder: Path) -> str:
    """The hash of a folder's encoder; `DatasetError` if its latents come from another one."""
    vae = encoder_hash(folder)
    for path in dataset.episode_paths(folder, ENCODED):
        if str(dataset.load_arrays(path, "vae")["vae"]) != vae:
            raise DatasetError(f"{path} belongs to another VAE; repeat `{shell_command('encode', '--data', folder)}`")
    return vae


def encodes_mirrored(folder: Path) -> bool:
    """Whether mirrored pictures of the folder's VAE can occur in a drive."""
    size, world = load_config(folder / CHECKPOINT, VAEConfig).picture, dataset.world_of_folder(folder)
    preprocessing = dataset.preprocessing_of_drives(dataset.existing_episodes(folder), size, world)
    return preprocessing.mirrors and dataset.find_world(*world).world.mirror is not None


def encoder_hash(folder: Path) -> str:
    """SHA-256, hexadecimal, of the encoder's weights; further training of the decoder alone does not change it."""
    hashed = hashlib.sha256()
    for name, array in sorted(load_weights(folder / CHECKPOINT).items()):
        if name.startswith(ENCODER):
            hashed.update(name.encode())
            hashed.update(array.tobytes())
    return hashed.hexdigest()


def _is_current(target: Path, vae: str) -> bool:
    """Whether an encoded episode is readable, has the arrays of this version, and comes from this VAE."""
    try:
        return str(dataset.load_arrays(target, "vae", "ended", "mu")["vae"]) == vae
    except DatasetError:
        return False


def _make_encoder(folder: Path, config: VAEConfig) -> Callable[[NDArray[np.uint8]], Latents]:
    """Return a function from pictures `(T, side, side, 3)` to `mu` and `logvar` `(T, latent)`, on torch's threads."""
    graph = export_encoder(load_weights(folder / CHECKPOINT), config)
    session = open_graph(graph, torch.get_num_threads())

    def encode_pictures(pictures: NDArray[np.uint8]) -> Latents:
        starts = range(0, len(pictures), BATCH)
        parts = [session.run(["mu", "logvar"], {"picture": pictures[start : start + BATCH]}) for start in starts]
        mu, logvar = (np.concatenate(each) for each in zip(*parts, strict=True))
        return mu, logvar

    return encode_pictures
