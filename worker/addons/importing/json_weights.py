"""Weights of hardmaru/WorldModelsExperiments, carracing: `vae.json`, `rnn.json`, `initial_z.json`.

A file is a list of arrays, each number 10,000 times the weight and rounded, in the order in which its program creates
them. The layers are the paper's, so a file of other layers is refused by the first array that does not fit.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.regular_files import read_regular
from dreamfleet.worker.worldmodel.mdnrnn_config import PAPER as PAPER_RNN
from dreamfleet.worker.worldmodel.vae_config import PAPER as PAPER_VAE

Weights = dict[str, NDArray[np.float32]]
MOST_BYTES = 512 << 20  # of a file; a VAE has 4.3 million weights, in some 40 MB of text
UNIT = 10_000.0
FORGET_BIAS = 1.0  # which TensorFlow's cell adds, and torch's does not


def read_json(path: Path) -> Any:
    """The value of a JSON file; `DatasetError` if it is none, or too large."""
    try:
        return json.loads(read_regular(path, MOST_BYTES))
    except FileNotFoundError:
        raise DatasetError(f"no file at {path}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path} is no JSON that can be read ({error})") from error


def read_vae(path: Path) -> Weights:
    """The paper's VAE, with torch's names and axes; `DatasetError` for other layers.

    Their pictures are ours minus 1, as 8-bit numbers. The first convolution's bias makes up for that.
    """
    down = [((layer.kernel, layer.kernel, layer.inputs, layer.outputs), (layer.outputs,)) for layer in PAPER_VAE.down]
    up = [((layer.kernel, layer.kernel, layer.outputs, layer.inputs), (layer.outputs,)) for layer in PAPER_VAE.up]
    flat, latent, first = PAPER_VAE.flat, PAPER_VAE.latent, PAPER_VAE.up[0].inputs
    dense = [((flat, latent), (latent,))] * 2 + [((latent, first), (first,))]
    arrays = iter(_read_arrays(path, [shape for pair in (*down, *dense, *up) for shape in pair]))
    weights: Weights = {}
    for index in range(len(down)):
        name = f"encoder.{index * PAPER_VAE.modules_a_layer}"
        weights[f"{name}.weight"], weights[f"{name}.bias"] = next(arrays).transpose(3, 2, 0, 1), next(arrays)
    weights["encoder.0.bias"] = weights["encoder.0.bias"] - weights["encoder.0.weight"].sum(axis=(1, 2, 3)) / 255
    side = PAPER_VAE.sides[-1]
    for name in ("mu", "logvar"):  # theirs flattens (row, column, channel), ours (channel, row, column)
        kernel = next(arrays).reshape(side, side, -1, latent).transpose(3, 2, 0, 1).reshape(latent, flat)
        weights[f"{name}.weight"], weights[f"{name}.bias"] = kernel, next(arrays)
    weights["dense.weight"], weights["dense.bias"] = next(arrays).T, next(arrays)
    for index in range(len(up)):
        name = f"decoder.{index * PAPER_VAE.modules_a_layer}"
        weights[f"{name}.weight"], weights[f"{name}.bias"] = next(arrays).transpose(3, 2, 0, 1), next(arrays)
    return _contiguous(weights)


def read_mdnrnn(path: Path) -> Weights:
    """The paper's MDN-RNN, with torch's names, axes and order of gates; `DatasetError` for other layers."""
    config = PAPER_RNN
    size, inputs, outputs = config.hidden, config.inputs, config.outputs
    shapes = [(size, outputs), (outputs,), (inputs + size, 4 * size), (4 * size,)]
    heads, head_biases, kernel, bias = _read_arrays(path, shapes)
    order = np.arange(outputs).reshape(config.latent, 3, config.mixtures).transpose(1, 0, 2).ravel()
    enter, candidate, forget, leave = np.split(np.arange(4 * size), 4)  # their order of gates
    gates = np.concatenate([enter, forget, candidate, leave])
    bias = bias.copy()
    bias[forget] += np.float32(FORGET_BIAS)
    return _contiguous({
        "lstm.weight_ih_l0": kernel[:inputs, gates].T,
        "lstm.weight_hh_l0": kernel[inputs:, gates].T,
        "lstm.bias_ih_l0": bias[gates],
        "lstm.bias_hh_l0": np.zeros(4 * size, np.float32),
        "heads.weight": heads[:, order].T,
        "heads.bias": head_biases[order],
    })  # fmt: skip


def read_initial_latents(path: Path) -> NDArray[np.float32]:
    """The first latents of recorded drives `(N, 2, latent)`, mu and logvar; `DatasetError` for other shapes."""
    value = read_json(path)
    try:
        mu, logvar = (np.asarray(each, np.float64) / UNIT for each in value)
        if mu.shape != logvar.shape or mu.shape[1:] != (PAPER_VAE.latent,) or not len(mu):
            raise ValueError(f"arrays of {mu.shape} and {logvar.shape}")
        found = np.stack([mu, logvar], axis=1).astype(np.float32)
    except (ValueError, TypeError, OverflowError) as error:
        raise DatasetError(f"{path} is no list of mu and logvar (N, {PAPER_VAE.latent}): {error}") from error
    return _finite(path, found)


def _read_arrays(path: Path, shapes: Sequence[tuple[int, ...]]) -> list[NDArray[np.float32]]:
    value = read_json(path)
    if not isinstance(value, list) or len(value) != len(shapes):
        found = f"{len(value)} of them" if isinstance(value, list) else "none"
        raise DatasetError(f"{path} must be a list of {len(shapes)} arrays, and holds {found}")
    arrays = []
    for number, (each, shape) in enumerate(zip(value, shapes, strict=True)):
        try:
            array = np.asarray(each, np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise DatasetError(f"{path}: array {number} is not of numbers ({error})") from error
        if array.shape != shape:
            raise DatasetError(
                f"{path}: array {number} has the shape {array.shape}, and the paper's layers have {shape} there"
            )
        arrays.append(_finite(path, (array / UNIT).astype(np.float32)))
    return arrays


def _finite(path: Path, array: NDArray[np.float32]) -> NDArray[np.float32]:
    if not np.isfinite(array).all():
        raise DatasetError(f"{path} holds NaN, infinity, or numbers beyond single precision")
    return array


def _contiguous(weights: Weights) -> Weights:
    return {name: np.ascontiguousarray(array, np.float32) for name, array in weights.items()}
