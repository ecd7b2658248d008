"""From trained weights to a bundle."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from dreamfleet.common.actions import Continuous
from dreamfleet.common.bundle import (
    DECODER,
    DREAM,
    ENCODER,
    INITIAL,
    LAYERED,
    LINEAR,
    POLICY,
    RECORDED,
    WEIGHTS,
    Bundle,
    Manifest,
    write_bundle,
)
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.fields import written
from dreamfleet.common.files import read_regular, write_aside
from dreamfleet.common.fingerprint import package_version
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.checkpoint import load_config, load_weights
from dreamfleet.worker.training.dataset import episodes, load, split
from dreamfleet.worker.training.encode import ENCODED, encoder_of
from dreamfleet.worker.training.recorded import recorded_states
from dreamfleet.worker.training.room import told_where_full
from dreamfleet.worker.training.world import WORLD, find_world, preprocessing_to
from dreamfleet.worker.worldmodel.export import (
    Weights,
    export_controller,
    export_decoder,
    export_dream,
    export_encoder,
    export_policy,
)
from dreamfleet.worker.worldmodel.mdnrnn_config import REWARDED, MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import PAPER, VAEConfig

QUALITY = "quality.json"
MEASURED, CIRCUMSTANCES = (
    ("probe", "losses", "likeness"),
    ("driver", "noise", "first_seed"),
)  # of what `inspect --json` tells
MOST_FIGURES = 1 << 18  # bytes: a manifest has a million at most
INITIAL_LATENTS = 256


def record_quality(folder: Path, figures: dict[str, float]) -> None:
    """Keep a model's figures beside the data, for the manifest."""
    path = folder / QUALITY
    known = json.loads(path.read_text()) if path.exists() else {}
    with told_where_full(path), write_aside(path) as file:
        file.write(json.dumps({**known, **figures}, indent=1).encode())


def assemble(
    folder: Path, out: Path, name: str, *, with_weights: bool, recorded: int = 0, measured: Sequence[Path] = ()
) -> Bundle:
    """Build the bundle of a data folder whose models are trained, with `recorded` states of its drives at most.

    `measured` are figures that `inspect --json` told of the same bundle without them; `DatasetError` if of another.
    """
    told = [(path, *_figures(path)) for path in measured]
    vae = load_weights(folder / train_vae.CHECKPOINT)
    rnn = load_weights(folder / train_mdnrnn.CHECKPOINT)
    configs = (
        load_config(folder / train_vae.CHECKPOINT, VAEConfig),
        load_config(folder / train_mdnrnn.CHECKPOINT, MDNRNNConfig),
    )
    for checkpoint, arrays in ((train_vae.CHECKPOINT, vae), (train_mdnrnn.CHECKPOINT, rnn)):
        if not all(np.isfinite(array).all() for array in arrays.values()):
            raise DatasetError(f"{folder / checkpoint} holds NaN or infinity; delete it and train again")
    if configs[0].latent != configs[1].latent:
        raise DatasetError(f"the VAE has {configs[0].latent} latents, the MDN-RNN {configs[1].latent}: train it again")
    if train_mdnrnn.vae_of(folder) != encoder_of(folder):
        raise DatasetError(f"the MDN-RNN in {folder} was trained on another VAE: train it again before you bundle")
    quality = folder / QUALITY
    provenance = {
        "episodes": len(episodes(folder)),
        "frames": sum(len(load(path, "reward")["reward"]) for path in episodes(folder)),
        "held_out_episodes": len(split(episodes(folder))[1]),
        "quality": json.loads(quality.read_text()) if quality.exists() else {},
        "versions": {package: package_version(package) for package in ("dreamfleet", "gymnasium", "torch")},
    }
    parts = graphs(vae, rnn, initial_latents(folder), *configs)
    if recorded:
        found = recorded_states(folder, recorded)
        if states := len(found.states):
            parts[RECORDED] = _npy(found.states)
            provenance["recorded"] = {"states": states, "before_losses": found.before_losses}
    if with_weights:
        tensors = {f"vae.{key}": value for key, value in vae.items()} | {f"mdnrnn.{k}": v for k, v in rnn.items()}
        parts[WEIGHTS] = save(
            tensors, {"vae": json.dumps(written(configs[0])), "mdnrnn": json.dumps(written(configs[1]))}
        )
    if told:
        with TemporaryDirectory() as aside:
            bare = write_bundle(Path(aside) / out.name, manifest(name, provenance, *configs), parts).sha256
        for path, of, _ in told:
            if of != bare:
                raise DatasetError(
                    f"{path} was measured of the world model {str(of)[:12]}..., and this folder makes {bare[:12]}...: "
                    "bundle that without --measured, and measure it"
                )
        provenance["measured"] = [figures for *_, figures in told]
    with told_where_full(out):
        return write_bundle(out, manifest(name, provenance, *configs), parts)


def _figures(path: Path) -> tuple[object, dict[str, Any]]:
    """Of which bundle `inspect --json` told figures, and these."""
    try:
        told = json.loads(read_regular(path, MOST_FIGURES))
        figures = {name: told[name] for name in MEASURED if name in told}
        circumstances = {name: told[name] for name in CIRCUMSTANCES}
        json.dumps(figures | circumstances, allow_nan=False)
        if not figures:
            raise ValueError(f"none of {', '.join(MEASURED)}")
        return told["bundle"], circumstances | figures
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"{path} holds no figures of `inspect BUNDLE --probe --json` ({error})") from error


def manifest(name: str, provenance: dict[str, Any], vae: VAEConfig = PAPER, rnn: MDNRNNConfig = REWARDED) -> Manifest:
    """The manifest of these models."""
    preprocessing = preprocessing_to(vae.picture)
    return Manifest(
        name=name,
        task=WORLD,
        preprocessing=preprocessing.name,
        picture=preprocessing.shape,
        latent=vae.latent,
        hidden=rnn.hidden,
        actions=rnn.actions,
        provenance=provenance,
        models={"vae": written(vae), "mdnrnn": written(rnn)},
    )


def graphs(
    vae: Weights,
    rnn: Weights,
    initial: NDArray[np.float32],
    vae_config: VAEConfig = PAPER,
    rnn_config: MDNRNNConfig = REWARDED,
) -> dict[str, bytes]:
    """The parts of a new bundle."""
    actions = find_world().world.actions
    if not isinstance(actions, Continuous) or actions.outputs_of:
        raise DatasetError(f"world models are built for continuous actions of an output each; those of {WORLD} are not")
    return {
        ENCODER: export_encoder(vae, vae_config),
        DECODER: export_decoder(vae, vae_config),
        POLICY: export_policy(vae, rnn, vae_config, rnn_config, actions),
        DREAM: export_dream(rnn, rnn_config),
        LINEAR: export_controller(actions, hidden=False),
        LAYERED: export_controller(actions, hidden=True),
        INITIAL: _npy(initial),
    }


def _npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def initial_latents(folder: Path) -> NDArray[np.float32]:
    """First `mu` and `logvar` of recorded rollouts, `(N, 2, latent)`: where dreams begin."""
    firsts = []
    for path in episodes(folder, ENCODED)[:INITIAL_LATENTS]:
        arrays = load(path, "mu", "logvar")
        firsts.append(np.stack([arrays["mu"][0], arrays["logvar"][0]]))
    return np.stack(firsts).astype(np.float32)
