"""Recover a model's weights from a bundle's graphs, so that training can resume from a bundle.

This is the inverse of `export`: it reads constants in the order in which that writes them. The decoder's and the heads'
weights stay rounded to half precision; exporting them again gives the same bytes.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from dreamfleet.common.errors import BundleError
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.mdnrnn_graph import mixture_major_order
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

Weights = dict[str, NDArray[np.float32]]


def vae_weights(encoder: bytes, decoder: bytes, config: VAEConfig) -> Weights:
    """Weights from the encoder's and the decoder's graph, by torch's names.

    `BundleError` with batch normalisation, which is folded into other weights, and for graphs with another layout.
    """
    if config.batch_norm:
        raise BundleError("its batch normalisation is folded into other weights, so it cannot be trained on")
    seen, made = _constants(encoder), _constants(decoder)
    layers = [layer * config.modules_a_layer for layer in range(len(config.channels))]
    found: Weights = {}
    for layer in layers:
        found |= _pair(f"encoder.{layer}", seen)
    # The export divided it by 255; the single-precision number nearest to the product is the original.
    found["encoder.0.weight"] = (found["encoder.0.weight"].astype(np.float64) * 255).astype(np.float32)
    for name in ("mu", "logvar"):
        found |= _pair(name, seen, transposed=not config.columns)
    for name in ("dense", *(f"decoder.{layer}" for layer in layers)):
        found |= _pair(name, made)
    return found


def mdnrnn_weights(dream: bytes, config: MDNRNNConfig) -> Weights:
    """Weights from the dream's graph, by torch's names; `BundleError` for a graph with another layout."""
    constants = _constants(dream)
    found: Weights = {}
    if config.window:
        found |= _pair("keys", constants, transposed=True)
        found |= {f"{name}.weight": _next(constants).T for name in ("query", "score")}
    gates = [_pair("gate", constants, transposed=True) for _ in range(4)]
    kernel = np.concatenate([each["gate.weight"] for each in gates])
    bias = np.concatenate([each["gate.bias"] for each in gates])
    entering, staying = np.split(kernel, [config.lstm_inputs], axis=1)
    found |= {"lstm.weight_ih_l0": entering, "lstm.weight_hh_l0": staying}
    found |= {"lstm.bias_ih_l0": bias, "lstm.bias_hh_l0": np.zeros_like(bias)}
    if config.columns:
        return found | _column_heads(constants, config)
    back = np.argsort(mixture_major_order(config))
    heads = _pair("heads", constants, transposed=True)
    if len(heads["heads.bias"]) != len(back):
        raise _unknown_layout()
    return found | {name: values[back] for name, values in heads.items()}


def _column_heads(constants: Iterator[NDArray[np.float32]], config: MDNRNNConfig) -> Weights:
    found = _pair("heads.near", constants) | _pair("heads.everywhere", constants, transposed=True)
    found |= _pair("heads.second", constants) | _pair("heads.mixtures", constants)
    if config.has_reward_head or config.done:
        found |= _pair("heads.others", constants, transposed=True)
    return found


def _constants(model: bytes) -> Iterator[NDArray[np.float32]]:
    """Yield the floating-point constants of a graph in order; integer constants are shapes."""
    try:
        graph = onnx.load_model_from_string(model).graph
    except Exception as error:  # protobuf's, which is not a dependency of ours
        raise _unknown_layout() from error
    for each in graph.initializer:
        array: NDArray[Any] = numpy_helper.to_array(each)
        if array.dtype.kind == "f":
            yield array.astype(np.float32)


def _pair(name: str, constants: Iterator[NDArray[np.float32]], *, transposed: bool = False) -> Weights:
    kernel, bias = _next(constants), _next(constants)
    return {f"{name}.weight": kernel.T if transposed else kernel, f"{name}.bias": bias}


def _next(constants: Iterator[NDArray[np.float32]]) -> NDArray[np.float32]:
    found = next(constants, None)
    if found is None:
        raise _unknown_layout()
    return found


def _unknown_layout() -> BundleError:
    return BundleError("its graphs are not laid out as this version writes them, so it cannot be trained on")
