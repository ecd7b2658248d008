"""Assemble a bundle from trained weights. Pages: worlds.md, sources.md, dreams-notes.md."""

from __future__ import annotations

import io
import json
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle import (
    DECODER,
    DREAM_GRAPH,
    ENCODER,
    INITIAL_LATENTS_PART,
    LAYERED_CONTROLLER,
    LINEAR_CONTROLLER,
    POLICY,
    RECORDED_STATES,
    WEIGHTS,
    Bundle,
    BundleManifest,
    write_bundle,
)
from dreamfleet.common.artifacts.world_facts import WorldFacts
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.files.regular_files import read_regular
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, DataWorld
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.checkpoint import load_config, load_progress, load_weights
from dreamfleet.worker.training.data import dataset
from dreamfleet.worker.training.data.data_folder import explain_write_errors
from dreamfleet.worker.training.data.recorded_states import compute_recorded_states
from dreamfleet.worker.training.dream_facts import RecordedRewards, Source, describe_world, warn_of_unsure_ends
from dreamfleet.worker.training.encode import ENCODED, latents_encoder_hash
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
MEASURED = ("probe", "losses", "likeness")  # keys of the output of `inspect --json`
CIRCUMSTANCES = ("driver", "noise", "first_seed")  # likewise
MOST_FIGURES = 1 << 18  # bytes; a manifest has at most a million
INITIAL_LATENTS = 256
log = logging.getLogger(__name__)


def record_quality(folder: Path, figures: dict[str, float]) -> None:
    """Store a model's quality figures in the data folder, for the manifest."""
    path = folder / QUALITY
    try:
        known = load_quality(folder)
    except DatasetError as error:
        log.warning("%s; the new figures replace it", error)
        known = {}
    with explain_write_errors(path), atomic_write(path) as file:
        file.write(json.dumps({**known, **figures}, indent=1).encode())


def load_quality(folder: Path) -> dict[str, Any]:
    """The figures that `record_quality` stored, empty if none; `DatasetError` if they are damaged."""
    path = folder / QUALITY
    try:
        figures = json.loads(read_regular(path, MOST_FIGURES))
        if not isinstance(figures, dict) or not all(type(each) in (int, float) for each in figures.values()):
            raise TypeError("it is no object of numbers")
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise DatasetError(f"{path} holds no figures ({error}): delete it, and a bundle has none") from error
    return figures


def assemble(
    folder: Path, out: Path, name: str, *, with_weights: bool, recorded: int = 0, measured: Sequence[Path] = (),
    reward: Source | None = None, end: str | None = None,
) -> Bundle:  # fmt: skip
    """Build the bundle of a data folder with trained models, with at most `recorded` states of its drives.

    `measured` are files of `inspect --json` on the same bundle without them; `DatasetError` if on another bundle.
    `reward` and `end` say how dreams pay and end, as in `describe_world`.
    """
    measurements = [(path, *_load_measurements(path)) for path in measured]
    vae, rnn, vae_config, rnn_config = _load_models(folder)
    configs = vae_config, rnn_config
    paths = dataset.episode_paths(folder)
    world, rewards = dataset.world_of_folder(folder), RecordedRewards.load(paths)
    preprocessing = dataset.preprocessing_of_drives(paths, vae_config.picture, world)
    facts = describe_world(world, rewards, rnn_config, reward, end)
    provenance = _make_provenance(folder, rewards, facts)
    warn_of_unsure_ends(facts.end, provenance["quality"])
    parts = export_graphs(vae, rnn, initial_latents(folder), *configs, world)
    if recorded:
        found = compute_recorded_states(folder, recorded)
        if states := len(found.states):
            parts[RECORDED_STATES] = _npy(found.states)
            provenance["recorded"] = {"states": states, "before_losses": found.before_losses}
    if with_weights:
        tensors = {f"vae.{key}": value for key, value in vae.items()} | {f"mdnrnn.{k}": v for k, v in rnn.items()}
        parts[WEIGHTS] = save(tensors)  # without metadata, which it writes in any order: the manifest has the layers
    manifest = make_manifest(name, provenance, facts, *configs, world, preprocessing)
    if measurements:
        with TemporaryDirectory() as aside:
            bare = write_bundle(Path(aside) / out.name, manifest, parts).sha256
        for path, of, _ in measurements:
            if of != bare:
                raise DatasetError(
                    f"{path} was measured on the world model {str(of)[:12]}..., and this folder makes {bare[:12]}...: "
                    "bundle it without --measured, and measure that bundle"
                )
        manifest = replace(manifest, provenance=provenance | {"measured": [figures for *_, figures in measurements]})
    with explain_write_errors(out):
        return write_bundle(out, manifest, parts)


def _load_models(folder: Path) -> tuple[Weights, Weights, VAEConfig, MDNRNNConfig]:
    """The weights and configurations of a folder's models; `DatasetError` unless they belong together."""
    paths = folder / train_vae.CHECKPOINT, folder / train_mdnrnn.CHECKPOINT
    vae, rnn = (load_weights(path) for path in paths)
    vae_config, rnn_config = load_config(paths[0], VAEConfig), load_config(paths[1], MDNRNNConfig)
    for path, arrays in zip(paths, (vae, rnn), strict=True):
        if not all(np.isfinite(array).all() for array in arrays.values()):
            raise DatasetError(f"{path} holds NaN or infinity; train again with --new")
    if vae_config.latent != rnn_config.latent:
        raise DatasetError(f"the VAE has {vae_config.latent} latents, the MDN-RNN {rnn_config.latent}: train it again")
    if load_progress(paths[1]).get("vae") != latents_encoder_hash(folder):
        raise DatasetError(f"the MDN-RNN in {folder} was trained on another VAE: train it again before you bundle")
    return vae, rnn, vae_config, rnn_config


def _make_provenance(folder: Path, rewards: RecordedRewards, facts: WorldFacts) -> dict[str, Any]:
    """What a bundle's manifest says of its data, the quality of its models, and the packages that trained them."""
    paths = dataset.episode_paths(folder)
    drivers = Counter(str(dataset.load_arrays(path, "driver")["driver"]) for path in paths)
    packages = sorted({"dreamfleet", "torch", *facts.packages})
    return {
        "episodes": len(paths),
        "frames": sum(len(dataset.load_arrays(path, "reward")["reward"]) for path in paths),
        "held_out_episodes": len(dataset.split_held_out(paths)[1]),
        "quality": load_quality(folder),
        "drivers": dict(sorted(drivers.items())),
        "deaths": rewards.deaths,
        "versions": {package: package_version(package) for package in packages},
    }


def _load_measurements(path: Path) -> tuple[object, dict[str, Any]]:
    """The SHA-256 of the bundle that a file of `inspect --json` measured, and its figures."""
    try:
        plain = json.loads(read_regular(path, MOST_FIGURES))
        figures = {name: plain[name] for name in MEASURED if name in plain}
        circumstances = {name: plain[name] for name in CIRCUMSTANCES}
        json.dumps(figures | circumstances, allow_nan=False)
        if not figures:
            raise ValueError(f"none of {', '.join(MEASURED)}")
        return plain["bundle"], circumstances | figures
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"{path} holds no figures of `inspect BUNDLE --probe --json` ({error})") from error


def make_manifest(
    name: str, provenance: dict[str, Any], facts: WorldFacts, vae: VAEConfig = PAPER, rnn: MDNRNNConfig = REWARDED,
    world: DataWorld = OF_FIRST_WORLD, preprocessing: Preprocessing | None = None,
) -> BundleManifest:  # fmt: skip
    """Make the manifest of these models of a data set's world, with the `facts` of that world.

    `preprocessing` is that of its pictures, by default the world's of their size.
    """
    preprocessing = preprocessing or dataset.preprocessing_of_size(vae.picture, world)
    return BundleManifest(
        name=name,
        task=world.task,
        preprocessing=preprocessing.name,
        picture=preprocessing.shape,
        latent=vae.latent,
        hidden=rnn.hidden,
        actions=rnn.actions,
        provenance=provenance,
        models={"vae": to_plain(vae), "mdnrnn": to_plain(rnn)},
        world=facts,
    )


def export_graphs(
    vae: Weights,
    rnn: Weights,
    initial: NDArray[np.float32],
    vae_config: VAEConfig = PAPER,
    rnn_config: MDNRNNConfig = REWARDED,
    world: DataWorld = OF_FIRST_WORLD,
) -> dict[str, bytes]:
    """Make the parts of a bundle, by name; only the first world's have graphs with a controller."""
    parts = {
        ENCODER: export_encoder(vae, vae_config),
        DECODER: export_decoder(vae, vae_config),
        DREAM_GRAPH: export_dream(rnn, rnn_config),
        INITIAL_LATENTS_PART: _npy(initial),
    }
    if world != OF_FIRST_WORLD:
        return parts
    actions = dataset.find_world().world.actions
    assert isinstance(actions, Continuous)
    return parts | {
        POLICY: export_policy(vae, rnn, vae_config, rnn_config, actions),
        LINEAR_CONTROLLER: export_controller(actions, hidden=False),
        LAYERED_CONTROLLER: export_controller(actions, hidden=True),
    }


def _npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def initial_latents(folder: Path) -> NDArray[np.float32]:
    """The first `mu` and `logvar` of recorded rollouts, `(N, 2, latent)`, from which dreams begin."""
    firsts = []
    for path in dataset.episode_paths(folder, ENCODED)[:INITIAL_LATENTS]:
        arrays = dataset.load_arrays(path, "mu", "logvar")
        firsts.append(np.stack([arrays["mu"][0], arrays["logvar"][0]]))
    return np.stack(firsts).astype(np.float32)
