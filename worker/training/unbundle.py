"""From a bundle back to what training goes on from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.numpy import load

from dreamfleet.common.artifacts.bundle import DECODER, DREAM_GRAPH, ENCODER, WEIGHTS, Bundle
from dreamfleet.common.errors import BundleError, DatasetError, UsageError
from dreamfleet.common.files.atomic_write import reporting_unwritable_folder
from dreamfleet.common.files.regular_files import path_exists
from dreamfleet.common.printable import one_line
from dreamfleet.common.serialization.validation import MalformedError, from_plain
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.checkpoint import save_checkpoint
from dreamfleet.worker.training.encode import encoder_hash
from dreamfleet.worker.worldmodel.export import export_decoder, export_dream, export_encoder
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae import VAE
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from dreamfleet.worker.worldmodel.weights_from_graphs import Weights, mdnrnn_weights, vae_weights


def unbundle(bundle: Bundle, folder: Path) -> tuple[Path, Path]:
    """Write a bundle's VAE and MDN-RNN into a data folder, as checkpoints that have made no update yet.

    `BundleError` if its models cannot be had again, to the bytes of its graphs; `UsageError` where the folder has one
    of them already; `DatasetError` where nothing can be written.
    """
    paths = folder / train_vae.CHECKPOINT, folder / train_mdnrnn.CHECKPOINT
    for path in paths:
        if path_exists(path):
            raise UsageError(f"{path} is there already: choose another --data, or remove it first")
    try:
        vae, rnn = _rebuild_models(bundle)
    except (BundleError, MalformedError, UsageError, RuntimeError, ValueError, TypeError, SafetensorError) as error:
        raise BundleError(f"{bundle.path}: {one_line(str(error))}") from error
    with reporting_unwritable_folder(folder, "choose another --data"):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        _save(paths[0], vae)
        _save(paths[1], rnn, vae=encoder_hash(folder))
    except DatasetError:
        for path in paths:  # both or none, so that it can be done again
            path.unlink(missing_ok=True)
        raise
    return paths


def _rebuild_models(bundle: Bundle) -> tuple[VAE, MDNRNN]:
    told = bundle.manifest.models
    if not told:
        raise BundleError("its manifest does not tell its models' layers: it is too old to train on from")
    seeing, remembering = from_plain(VAEConfig, told.get("vae")), from_plain(MDNRNNConfig, told.get("mdnrnn"))
    weights = _weights(bundle, seeing, remembering)
    with torch.device("meta"):  # shapes alone: what the manifest tells need not be true
        for model, arrays in zip((VAE(seeing), MDNRNN(remembering)), weights, strict=True):
            model.load_state_dict(_tensors(arrays, "meta"))
    vae, rnn = VAE(seeing), MDNRNN(remembering)
    vae.load_state_dict(_tensors(weights[0]))
    rnn.load_state_dict(_tensors(weights[1]))
    _check_graphs(bundle, weights, seeing, remembering)
    return vae, rnn


def _weights(bundle: Bundle, vae: VAEConfig, rnn: MDNRNNConfig) -> tuple[Weights, Weights]:
    """As they were trained, where the bundle keeps them; otherwise as its graphs hold them."""
    if WEIGHTS in bundle.manifest.parts:
        kept = load(bundle.read(WEIGHTS))
        return _select_model("vae", kept), _select_model("mdnrnn", kept)
    return (
        vae_weights(bundle.read(ENCODER), bundle.read(DECODER), vae),
        mdnrnn_weights(bundle.read(DREAM_GRAPH), rnn),
    )


def _select_model(model: str, kept: Weights) -> Weights:
    return {name.removeprefix(f"{model}."): array for name, array in kept.items() if name.startswith(f"{model}.")}


def _tensors(weights: Weights, device: str = "cpu") -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array.copy()).to(device) for name, array in weights.items()}


def _check_graphs(bundle: Bundle, weights: tuple[Weights, Weights], vae: VAEConfig, rnn: MDNRNNConfig) -> None:
    """`BundleError` if frozen again they are not what the bundle has: neither manifest nor weights need be true."""
    again = {ENCODER: export_encoder(weights[0], vae), DECODER: export_decoder(weights[0], vae),
             DREAM_GRAPH: export_dream(weights[1], rnn)}  # fmt: skip
    for name, graph in again.items():
        if graph != bundle.read(name):
            raise BundleError(f"its {name} is not what its weights and its manifest make, so it cannot be trained on")


def _save(path: Path, model: VAE | MDNRNN, **more: Any) -> None:
    save_checkpoint(path, model, torch.optim.Adam(model.parameters()), {"update": 0, **more})
