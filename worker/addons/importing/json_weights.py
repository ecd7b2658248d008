"""Weights of hardmaru/WorldModelsExperiments, carracing and doomrnn: `vae.json`, `rnn.json`, `initial_z.json`.

A file is a list of arrays, each number 10,000 times the weight and rounded, in the order in which its program creates
them. The layers are the paper's, so a file of other layers is refused by the first array that does not fit.

Doom's MDN-RNN creates its LSTM before its heads, and the end's logit is the first head. It has an input more, which is
1 at the first step of a game and 0 after it. In our LSTM that input is a part of the bias, and a unit more takes it
away again: that unit is 0 at the first step and tanh(1) after it.
"""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.regular_files import read_regular
from dreamfleet.worker.worldmodel.mdnrnn_config import PAPER as PAPER_RNN
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

Weights = dict[str, NDArray[np.float32]]
MOST_BYTES = 512 << 20  # of a file; a VAE has 4.3 million weights, in some 40 MB of text
UNIT = 10_000.0
FORGET_BIAS = 1.0  # which TensorFlow's cell adds, and torch's does not
ENDING_UNITS = 512  # of Doom's, which predicts ends
ENDING_RNN = MDNRNNConfig(latent=64, actions=1, hidden=ENDING_UNITS + 1, reward="none", done=True, done_weight=10.0)
OPEN = 40.0  # before a sigmoid or tanh: 1 in single precision
NO_NUMBERS = re.compile(rb"[^][ \t\r\n,.+\-0-9eE].{,9}", re.DOTALL)  # nothing that lists of numbers hold
MOST = float(np.finfo(np.float16).max)  # of a weight: a bundle has some in half precision
MOST_LOGVAR = 20.0  # a deviation of 22,000


def read_json(path: Path, refused: re.Pattern[bytes] | None = None) -> Any:
    """The value of a JSON file; `DatasetError` if it is none, is too large, or holds what is `refused`."""
    try:
        data = read_regular(path, MOST_BYTES)
        if refused and (found := refused.search(data)):
            raise DatasetError(f"{path} must be lists of numbers, and holds {found[0]!r}")
        return json.loads(data)
    except FileNotFoundError:
        raise DatasetError(f"no file at {path}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path} is no JSON that can be read ({error})") from error


def read_vae(path: Path, config: VAEConfig) -> Weights:
    """A VAE of the paper's layers, with torch's names and axes; `DatasetError` for other layers.

    Their pictures are ours minus 1, as 8-bit numbers. The first convolution's bias makes up for that.
    """
    down = [((layer.kernel, layer.kernel, layer.inputs, layer.outputs), (layer.outputs,)) for layer in config.down]
    up = [((layer.kernel, layer.kernel, layer.outputs, layer.inputs), (layer.outputs,)) for layer in config.up]
    flat, latent, first = config.flat, config.latent, config.up[0].inputs
    dense = [((flat, latent), (latent,))] * 2 + [((latent, first), (first,))]
    shapes = [shape for pair in (*down, *dense, *up) for shape in pair]
    arrays = iter(_to_arrays(path, read_json(path, NO_NUMBERS), shapes))
    weights: Weights = {}
    for index in range(len(down)):
        name = f"encoder.{index * config.modules_a_layer}"
        weights[f"{name}.weight"], weights[f"{name}.bias"] = next(arrays).transpose(3, 2, 0, 1), next(arrays)
    weights["encoder.0.bias"] = weights["encoder.0.bias"] - weights["encoder.0.weight"].sum(axis=(1, 2, 3)) / 255
    side = config.sides[-1]
    for name in ("mu", "logvar"):  # theirs flattens (row, column, channel), ours (channel, row, column)
        kernel = next(arrays).reshape(side, side, -1, latent).transpose(3, 2, 0, 1).reshape(latent, flat)
        weights[f"{name}.weight"], weights[f"{name}.bias"] = kernel, next(arrays)
    weights["dense.weight"], weights["dense.bias"] = next(arrays).T, next(arrays)
    for index in range(len(up)):
        name = f"decoder.{index * config.modules_a_layer}"
        weights[f"{name}.weight"], weights[f"{name}.bias"] = next(arrays).transpose(3, 2, 0, 1), next(arrays)
    return _contiguous(weights)


def read_mdnrnn(path: Path) -> tuple[Weights, MDNRNNConfig]:
    """CarRacing's or Doom's MDN-RNN, with torch's names, axes and order of gates; `DatasetError` for other layers."""
    value = read_json(path, NO_NUMBERS)
    first = value[0] if isinstance(value, list) and value else None
    if isinstance(first, list) and len(first) == ENDING_RNN.inputs + 1 + ENDING_UNITS:
        return _to_ending_rnn(path, value), ENDING_RNN
    config = PAPER_RNN
    size, inputs, outputs = config.hidden, config.inputs, config.outputs
    shapes = [(size, outputs), (outputs,), (inputs + size, 4 * size), (4 * size,)]
    heads, head_biases, kernel, bias = _to_arrays(path, value, shapes)
    order = _order_of_heads(config)
    kernel, bias = _to_gates(kernel, bias)
    return _contiguous({
        "lstm.weight_ih_l0": kernel[:, :inputs],
        "lstm.weight_hh_l0": kernel[:, inputs:],
        "lstm.bias_ih_l0": bias,
        "lstm.bias_hh_l0": np.zeros(4 * size, np.float32),
        "heads.weight": heads[:, order].T,
        "heads.bias": head_biases[order],
    }), config  # fmt: skip


def _to_ending_rnn(path: Path, value: Any) -> Weights:
    size, inputs, outputs = ENDING_UNITS, ENDING_RNN.inputs, ENDING_RNN.outputs
    shapes = [(inputs + 1 + size, 4 * size), (4 * size,), (size, outputs), (outputs,)]
    kernel, bias, heads, head_biases = _to_arrays(path, value, shapes)
    order = np.append(1 + _order_of_heads(ENDING_RNN), 0)
    kernel, bias = _to_gates(kernel, bias)
    seen, first, recalled = np.split(kernel, [inputs, inputs + 1], axis=1)
    recalled = np.concatenate([recalled, -first / np.float32(math.tanh(1))], axis=1)
    return _contiguous({
        "lstm.weight_ih_l0": _with_unit(seen, np.zeros(4)),
        "lstm.weight_hh_l0": _with_unit(recalled, np.zeros(4)),
        "lstm.bias_ih_l0": _with_unit(bias + first[:, 0], OPEN * np.array([1, -1, 1, 1])),
        "lstm.bias_hh_l0": np.zeros(4 * (size + 1), np.float32),
        "heads.weight": np.pad(heads[:, order].T, [(0, 0), (0, 1)]),
        "heads.bias": head_biases[order],
    })  # fmt: skip


def _to_gates(kernel: NDArray[np.float32], bias: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    """A cell's kernel (4 * units, inputs) and bias (4 * units,) with torch's axes and order of gates."""
    enter, candidate, forget, leave = np.split(np.arange(len(bias)), 4)  # their order of gates
    gates = np.concatenate([enter, forget, candidate, leave])
    bias = bias.copy()
    bias[forget] += np.float32(FORGET_BIAS)
    return kernel[:, gates].T, bias[gates]


def _with_unit(rows: NDArray[np.float32], values: NDArray[np.float64]) -> NDArray[np.float32]:
    """The rows of four gates with a unit more in each gate, whose numbers are that gate's of `values`."""
    gates = zip(np.split(rows, 4), values, strict=True)
    return np.concatenate([np.append(gate, np.full_like(gate[:1], value), axis=0) for gate, value in gates])


def _order_of_heads(config: MDNRNNConfig) -> NDArray[np.int64]:
    """Where each of our heads of the mixtures is among theirs, which are in order of latents."""
    order = np.arange(3 * config.latent * config.mixtures).reshape(config.latent, 3, config.mixtures)
    return order.transpose(1, 0, 2).ravel()


def read_initial_latents(path: Path, latent: int) -> NDArray[np.float32]:
    """The first latents of recorded drives `(N, 2, latent)`, mu and logvar; `DatasetError` for other shapes."""
    value = read_json(path, NO_NUMBERS)
    try:
        mu, logvar = (np.asarray(each, np.float64) / UNIT for each in value)
        if mu.shape != logvar.shape or mu.shape[1:] != (latent,) or not len(mu):
            raise ValueError(f"arrays of {mu.shape} and {logvar.shape}")
        if logvar.max() > MOST_LOGVAR:
            raise ValueError(f"a logvar of {logvar.max():g}, and at most {MOST_LOGVAR:g} is read")
    except (ValueError, TypeError, OverflowError) as error:
        raise DatasetError(f"{path} is no list of mu and logvar (N, {latent}): {error}") from error
    return check_range(path, np.stack([mu, logvar], axis=1))


def _to_arrays(path: Path, value: Any, shapes: Sequence[tuple[int, ...]]) -> list[NDArray[np.float32]]:
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
        arrays.append(check_range(path, array / UNIT))
    return arrays


def check_range(where: object, numbers: NDArray[Any]) -> NDArray[np.float32]:
    """The numbers in single precision; `DatasetError` unless sums and products of a few of them are finite there."""
    if not (np.abs(numbers) <= MOST).all():  # false for NaN too
        raise DatasetError(f"{where} holds NaN, infinity, or numbers beyond half precision")
    return numbers.astype(np.float32)


def _contiguous(weights: Weights) -> Weights:
    return {name: np.ascontiguousarray(array, np.float32) for name, array in weights.items()}
