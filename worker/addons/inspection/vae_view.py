"""A VAE to inspect: of a bundle, or of a data folder in which only the VAE is trained so far."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import MissingExtraError
from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig, EncodedRollout
from dreamfleet.worker.worldmodel.inference import Decoder, Encoder, open_graph

Floats = NDArray[np.float32]
Pictures = NDArray[np.uint8]
NEEDED = ("torch", "onnx", "safetensors")  # packages of the extra `train` that reading a checkpoint needs
CHECKPOINT = "vae.safetensors"


@dataclass(frozen=True)
class VAEView:
    """A VAE's functions on pictures `(N, side, side, 3)` and latents `(N, latent)`."""

    side: int
    latent: int
    encode: Callable[[Pictures], tuple[Floats, Floats]]  # to `mu` and `logvar`
    decode: Callable[[Floats], Pictures]

    @classmethod
    def of_bundle(cls, bundle: Bundle) -> VAEView:
        """The VAE of a world model."""
        manifest = bundle.manifest
        return cls(manifest.picture[0], manifest.latent, Encoder(bundle).encode, Decoder(bundle).decode)

    @classmethod
    def of_folder(cls, folder: Path) -> VAEView:
        """The last checkpoint in a data folder; `DatasetError` if there is none or it is damaged."""
        if missing := [each for each in NEEDED if find_spec(each) is None]:
            raise MissingExtraError(f"a VAE outside a bundle needs {missing[0]!r}: pip install 'dreamfleet[train]'")
        from dreamfleet.worker.training.checkpoint import load_config, load_weights
        from dreamfleet.worker.worldmodel.export import export_decoder, export_encoder
        from dreamfleet.worker.worldmodel.vae_config import VAEConfig

        config, weights = load_config(folder / CHECKPOINT, VAEConfig), load_weights(folder / CHECKPOINT)
        encoder, decoder = (open_graph(export(weights, config), 1) for export in (export_encoder, export_decoder))

        def encode(picture: Pictures) -> tuple[Floats, Floats]:
            mu, logvar = encoder.run(["mu", "logvar"], {"picture": picture})
            return mu, logvar

        def decode(latent: Floats) -> Pictures:
            (picture,) = decoder.run(["picture"], {"latent": latent})
            return np.asarray(picture, dtype=np.uint8)

        return cls(config.picture, config.latent, encode, decode)


def held_out_drive(folder: Path, vae_view: VAEView, config: DriveConfig) -> EncodedRollout:
    """Load the first held-out drive of a data set, `config.steps` steps at most."""
    from dreamfleet.worker.training.data import dataset

    _, (path, *_) = dataset.split_held_out(dataset.episode_paths(folder))
    dataset.check_pictures([path], vae_view.side)
    seen, steps = dataset.load_pictures(path)[: config.steps], dataset.load_steps(path)
    mu, logvar = vae_view.encode(seen)
    action, reward = (steps[name][: len(seen)] for name in ("action", "reward"))
    about, opening = (
        f"drive {path.stem}, which is held out",
        dataset.find_world(*dataset.world_of_folder(folder)).world.opening,
    )
    return EncodedRollout(seen, mu, logvar, action, reward.astype(np.float64), about, opening)
