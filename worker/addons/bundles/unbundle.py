"""Turn a bundle back into checkpoints from which training can resume. Pages: determinism.md."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.numpy import load

from dreamfleet.common.artifacts.bundle import (
    DECODER,
    DREAM_GRAPH,
    EIGHT_BITS,
    ENCODER,
    SINGLE_PRECISION,
    WEIGHTS,
    Bundle,
)
from dreamfleet.common.artifacts.bundle_store import describe_bundle
from dreamfleet.common.errors import BundleError, DatasetError, UsageError
from dreamfleet.common.files.regular_files import path_exists
from dreamfleet.common.printable import one_line
from dreamfleet.common.schema.validation import MalformedError, from_plain
from dreamfleet.worker.addons.bundles.weights_from_graphs import Weights, mdnrnn_weights, vae_weights
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.checkpoint import save_checkpoint
from dreamfleet.worker.training.data.data_folder import explain_folder_errors
from dreamfleet.worker.training.encode import encoder_hash
from dreamfleet.worker.worldmodel.eight_bits import Ranges
from dreamfleet.worker.worldmodel.export import export_decoder, export_dream, export_encoder
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae import VAE
from dreamfleet.worker.worldmodel.vae_config import VAEConfig


def unbundle(bundle: Bundle, folder: Path) -> tuple[Path, Path]:
    """Write a bundle's VAE and MDN-RNN into a data folder as checkpoints with no updates made.

    `BundleError` if its models cannot be restored to the bytes of its graphs; `UsageError` if the folder already has
    such a checkpoint; `DatasetError` if it cannot be written.
    """
    paths = folder / train_vae.CHECKPOINT, folder / train_mdnrnn.CHECKPOINT
    for path in paths:
        if path_exists(path):
            raise UsageError(f"{path} exists: choose another --data")
    found = restore_models(bundle)
    vae, rnn = VAE(found.vae_config), MDNRNN(found.mdnrnn_config)
    vae.load_state_dict(_tensors(found.vae))
    rnn.load_state_dict(_tensors(found.mdnrnn))
    with explain_folder_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        _save(paths[0], vae)
        _save(paths[1], rnn, vae=encoder_hash(folder))
    except DatasetError:
        for path in paths:  # both or none, so that it can be done again
            path.unlink(missing_ok=True)
        raise
    return paths


@dataclass(frozen=True)
class Models:
    """The configurations and weights of a bundle's models, and the ranges of eight-bit products."""

    vae_config: VAEConfig
    mdnrnn_config: MDNRNNConfig
    vae: Weights
    mdnrnn: Weights
    ranges: Ranges | None


def restore_models(bundle: Bundle) -> Models:
    """The models of a bundle; `BundleError` if they cannot be restored to the bytes of its graphs."""
    try:
        return _restore(bundle)
    except (BundleError, MalformedError, UsageError, RuntimeError, ValueError, TypeError, SafetensorError) as error:
        raise BundleError(f"{bundle.path}: {one_line(str(error))}") from error


def _restore(bundle: Bundle) -> Models:
    plain = bundle.manifest.models
    if not plain:
        raise BundleError("its manifest lacks its models' layers: it is too old to resume training from")
    seeing, remembering = from_plain(VAEConfig, plain.get("vae")), from_plain(MDNRNNConfig, plain.get("mdnrnn"))
    ranges = from_plain(Ranges, plain[EIGHT_BITS]) if EIGHT_BITS in plain else None
    if ranges is not None and WEIGHTS not in bundle.manifest.parts:
        whole = describe_bundle(str(bundle.manifest.provenance.get(SINGLE_PRECISION, "")))
        raise BundleError(f"its weights are rounded to eight bits: take the bundle that it was made of, {whole}")
    weights = _weights(bundle, seeing, remembering)
    with torch.device("meta"):  # check shapes without memory: the manifest may be wrong
        for model, arrays in zip((VAE(seeing), MDNRNN(remembering)), weights, strict=True):
            model.load_state_dict(_tensors(arrays, "meta"))
    models = Models(seeing, remembering, *weights, ranges)
    _check_graphs(bundle, models)
    return models


def _weights(bundle: Bundle, vae: VAEConfig, rnn: MDNRNNConfig) -> tuple[Weights, Weights]:
    """The trained weights if the bundle has them, otherwise those in its graphs."""
    if WEIGHTS in bundle.manifest.parts:
        kept = load(bundle.read(WEIGHTS))
        return _select_model("vae", kept), _select_model("mdnrnn", kept)
    return (vae_weights(bundle.read(ENCODER), bundle.read(DECODER), vae), mdnrnn_weights(bundle.read(DREAM_GRAPH), rnn))


def _select_model(model: str, kept: Weights) -> Weights:
    return {name.removeprefix(f"{model}."): array for name, array in kept.items() if name.startswith(f"{model}.")}


def _tensors(weights: Weights, device: str = "cpu") -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array.copy()).to(device) for name, array in weights.items()}


def _check_graphs(bundle: Bundle, models: Models) -> None:
    """`BundleError` unless exporting the weights gives the bundle's graphs again: manifest or weights may be wrong."""
    again = {ENCODER: export_encoder(models.vae, models.vae_config, models.ranges),
             DECODER: export_decoder(models.vae, models.vae_config),
             DREAM_GRAPH: export_dream(models.mdnrnn, models.mdnrnn_config, models.ranges)}  # fmt: skip
    for name, graph in again.items():
        if graph != bundle.read(name):
            raise BundleError(f"its {name} does not match its weights and manifest, so training cannot resume from it")


def _save(path: Path, model: VAE | MDNRNN, **more: Any) -> None:
    save_checkpoint(path, model, torch.optim.Adam(model.parameters()), {"update": 0, **more})
