"""World models and controllers of ctallec/world-models: `vae/best.tar`, `mdrnn/best.tar` and `ctrl/best.tar`.

Its LSTM takes the action before the latent, its encoder gives the log deviation, its mixture has one weight for all
latents, and its controller's outputs are the action. A bundle says the rest: the layers, the pictures and the heads.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.worker.addons.importing.json_weights import Weights
from dreamfleet.worker.addons.importing.sources import CONTROLLER, MDRNN, VAE
from dreamfleet.worker.addons.importing.torch_files import array_of, read_torch_file
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

SOURCE = "ctallec/world-models"
ACTIONS = 3
PICTURES = "whole-64"
State = dict[str, torch.Tensor]


class MDNRNNWeights(NamedTuple):
    """The weights of an MDN-RNN with torch's names, and its layers."""

    weights: Weights
    config: MDNRNNConfig


class _Checkpoint(NamedTuple):
    """What a file holds, and the tensors of its `state_dict`."""

    path: Path
    content: Mapping[str, Any]
    weights: State


class VAEWeights(NamedTuple):
    """The weights of a VAE with torch's names, and its layers."""

    weights: Weights
    config: VAEConfig


def read_vae(path: Path) -> VAEWeights:
    """The VAE of a checkpoint; `DatasetError` for other layers."""
    state = _read_state(path, "encoder.fc_mu.weight", "the VAE").weights
    latent, _ = _two_axes(path, state, "encoder.fc_mu.weight")
    config = _configure(path, VAEConfig, latent=latent, activate_dense=True)
    weights: Weights = {}
    for part, layers, theirs in (("encoder", config.down, "conv"), ("decoder", config.up, "deconv")):
        for index, layer in enumerate(layers):
            ends = (layer.outputs, layer.inputs) if part == "encoder" else (layer.inputs, layer.outputs)
            name = f"{part}.{theirs}{index + 1}"
            weights |= _pair(path, state, name, f"{part}.{index * config.modules_a_layer}",
                             (*ends, layer.kernel, layer.kernel), layer.outputs)  # fmt: skip
    weights |= _pair(path, state, "encoder.fc_mu", "mu", (latent, config.flat), latent)
    spread = _pair(path, state, "encoder.fc_logsigma", "logvar", (latent, config.flat), latent)
    weights |= {name: 2 * array for name, array in spread.items()}  # the log of a variance
    first = config.up[0].inputs
    weights |= _pair(path, state, "decoder.fc1", "dense", (first, latent), first)
    return VAEWeights(weights, config)


def read_mdnrnn(path: Path) -> MDNRNNWeights:
    """The MDN-RNN of a checkpoint; `DatasetError` for other layers.

    Its reward head was trained only with `--include_reward`; without, its weights never had a gradient, as the
    optimiser's state in the file says. The model then has no such head.
    """
    checkpoint = _read_state(path, "gmm_linear.weight", "the MDN-RNN")
    state = {name.removesuffix("_l0"): tensor for name, tensor in checkpoint.weights.items()}  # an LSTM's, or a cell's
    rows, hidden = _two_axes(path, state, "gmm_linear.weight")
    latent = _two_axes(path, state, "rnn.weight_ih")[1] - ACTIONS
    mixtures, rest = divmod(rows - 2, 2 * latent + 1) if latent > 0 else (0, 1)
    if rest or mixtures < 1:
        raise DatasetError(f"{path}: {rows} outputs are no mixture of {latent} latents with a reward and an end")
    reward = "none" if _is_reward_untrained(checkpoint, (rows, hidden)) else "value"
    config = _configure(
        path, MDNRNNConfig, latent=latent, hidden=hidden, mixtures=mixtures, reward=reward, done=True, joint=True
    )
    heads = _pair(path, state, "gmm_linear", "heads", (rows, hidden), rows)
    order = _heads_order(config)
    inputs = np.r_[ACTIONS : ACTIONS + latent, :ACTIONS]  # theirs: action, latent
    weights = {name: array[order] for name, array in heads.items()}
    for name, shape in (
        ("weight_ih", (4 * hidden, latent + ACTIONS)), ("weight_hh", (4 * hidden, hidden)),
        ("bias_ih", (4 * hidden,)), ("bias_hh", (4 * hidden,)),
    ):  # fmt: skip
        weights[f"lstm.{name}_l0"] = _array(path, state, f"rnn.{name}", shape)
    weights["lstm.weight_ih_l0"] = np.ascontiguousarray(weights["lstm.weight_ih_l0"][:, inputs])
    weights["lstm.bias_ih_l0"] = weights["lstm.bias_ih_l0"] + weights["lstm.bias_hh_l0"]  # ours has one bias
    weights["lstm.bias_hh_l0"] = np.zeros(4 * hidden, np.float32)
    return MDNRNNWeights(weights, config)


def read_controller(path: Path) -> NDArray[np.float32]:
    """The parameters `(size,)` of a checkpoint's controller: weights (actions, latent + hidden), then biases."""
    state = _read(path).weights
    if "fc.weight" not in state:
        raise DatasetError(f"{path} holds no controller, but a part of a world model: {world_command(path)} reads both")
    outputs, inputs = _two_axes(path, state, "fc.weight")
    if outputs != ACTIONS:
        raise DatasetError(f"{path}: its controller has {outputs} outputs, and {SOURCE} has {ACTIONS}")
    pair = _pair(path, state, "fc", "fc", (outputs, inputs), outputs)
    return np.concatenate([pair["fc.weight"].ravel(), pair["fc.bias"]])


def world_command(path: Path) -> str:
    """The command that imports the world model of a checkpoint's program."""
    parts = (VAE, MDRNN, CONTROLLER)
    logdir = shlex.quote(str(path.parent.parent)) if path.absolute().parent.name in parts else "LOGDIR"
    return f"`dreamfleet import {logdir} --out world.zip`"


def _is_reward_untrained(checkpoint: _Checkpoint, shape: tuple[int, int]) -> bool:
    """Whether the optimiser never saw a gradient of the reward's row of the heads `shape`."""
    optimiser = checkpoint.content.get("optimizer")
    states = optimiser.get("state") if isinstance(optimiser, dict) else None
    for each in states.values() if isinstance(states, dict) else ():
        squares = each.get("square_avg") if isinstance(each, dict) else None
        if isinstance(squares, torch.Tensor) and squares.shape == shape:
            return not array_of(squares, checkpoint.path)[-2].any()
    return False


def _heads_order(config: MDNRNNConfig) -> NDArray[np.int64]:
    """Their rows (means, log deviations: mixture-major; log weights; reward, end) in our order."""
    width = config.mixtures * config.latent
    means = np.arange(width).reshape(config.mixtures, config.latent).T.ravel()
    logits = 2 * width + np.arange(config.mixtures)
    last = 2 * width + config.mixtures
    return np.concatenate([logits, means, width + means, np.arange(last + (not config.has_reward_head), last + 2)])


def _configure(path: Path, kind: Any, **values: Any) -> Any:
    try:
        return kind(**values)
    except UsageError as error:
        raise DatasetError(f"{path}: {error}") from error


def _read_state(path: Path, needed: str, what: str) -> _Checkpoint:
    found = _read(path)
    if needed not in found.weights:
        raise DatasetError(f"{path} holds no {needed}: it is not {what} of {SOURCE}")
    return found


def _read(path: Path) -> _Checkpoint:
    content = read_torch_file(path)
    state = content.get("state_dict") if isinstance(content, Mapping) else None
    pairs: list[tuple[Any, Any]] = list(state.items()) if isinstance(state, dict) else [(None, None)]
    if not all(isinstance(name, str) and isinstance(each, torch.Tensor) for name, each in pairs):
        raise DatasetError(f"{path} holds no state_dict of tensors: it is no checkpoint of {SOURCE}")
    return _Checkpoint(path, content, dict(pairs))


def _two_axes(path: Path, state: State, name: str) -> tuple[int, int]:
    shape = tuple(state[name].shape) if name in state else ()
    if len(shape) != 2:
        raise DatasetError(f"{path}: {name} must have two axes, not {shape}")
    return shape[0], shape[1]


def _pair(path: Path, state: State, theirs: str, ours: str, shape: tuple[int, ...], outputs: int) -> Weights:
    return {
        f"{ours}.weight": _array(path, state, f"{theirs}.weight", shape),
        f"{ours}.bias": _array(path, state, f"{theirs}.bias", (outputs,)),
    }


def _array(path: Path, state: State, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    tensor = state.get(name)
    if tensor is None or tensor.shape != shape:
        found = "is missing" if tensor is None else f"has the shape {tuple(tensor.shape)}"
        raise DatasetError(f"{path}: {name} {found}, and {SOURCE} has {shape} there")
    if not tensor.is_floating_point():
        raise DatasetError(f"{path}: {name} is of type {tensor.dtype}, not of floating-point numbers")
    array = array_of(tensor, path)
    if not np.isfinite(array).all():
        raise DatasetError(f"{path}: {name} holds NaN, infinity, or numbers beyond single precision")
    return array
