"""Write the ONNX graphs of a world model node by node from its weights.

They are written by hand rather than traced, because a row's bits must not depend on the batch: weights are constant
initializers, and no node gathers, loops or reshapes by a traced batch size. docs/explanation/determinism.md says which
hosts share bits. A bundle that exists plays by its own graphs, but `unbundle` compares them with those of today: a
change of their bytes needs new bundles. Pages: decisions.md.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.worker.worldmodel.eight_bits import PIXEL_STEP, Ranges, add_convolution, add_product
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.mdnrnn_graph import RecurrentGraph, Weights, export_dream
from dreamfleet.worker.worldmodel.onnx_graph import GraphBuilder
from dreamfleet.worker.worldmodel.vae_config import LEAK, ConvolutionLayer, VAEConfig

__all__ = [
    "Weights",
    "export_controller",
    "export_decoder",
    "export_dream",
    "export_encoder",
    "export_policy",
    "squash",
]
EPSILON = 1e-5  # of torch's batch normalisation
BESIDE = (0, 1, 0, 1)  # padding of a layer between map and columns


def export_encoder(vae: Weights, config: VAEConfig, ranges: Ranges | None = None) -> bytes:
    """Export the encoder: `picture` (N, side, side, 3) uint8 to `mu` and `logvar` (N, latent).

    With `ranges` its products are of eight-bit integers.
    """
    graph = GraphBuilder("encoder")
    picture = graph.add_input("picture", TensorProto.UINT8, config.picture, config.picture, 3)
    encoded = _encode(graph, picture, vae, config, ranges)
    for name in ("mu", "logvar"):
        graph.add_output(encoded(name), name, TensorProto.FLOAT, config.latent)
    return graph.build()


def export_activations(vae: Weights, config: VAEConfig) -> bytes:
    """Export the encoder's convolutions: `picture` to the largest output of each, `layer0` (N, 1, 1, 1) and so on."""
    graph = GraphBuilder("activations")
    picture = graph.add_input("picture", TensorProto.UINT8, config.picture, config.picture, 3)
    value = graph.node("Cast", graph.node("Transpose", picture, perm=[0, 3, 1, 2]), to=TensorProto.FLOAT)
    for index in range(len(config.down)):
        value = _convolve(graph, value, vae, config, index)
        largest = graph.node("ReduceMax", value, axes=[1, 2, 3])
        graph.add_output(largest, f"layer{index}", TensorProto.FLOAT, 1, 1, 1)
    return graph.build()


def export_decoder(vae: Weights, config: VAEConfig) -> bytes:
    """Export the decoder: `latent` (N, latent) to `picture` (N, side, side, 3) uint8.

    Weights are stored in half precision and computed with in single precision.
    """
    graph = GraphBuilder("decoder")
    latent = graph.add_input("latent", TensorProto.FLOAT, config.latent)
    kernel, bias = graph.weight(vae["dense.weight"]), graph.weight(vae["dense.bias"])
    if config.columns:
        value = graph.node("Reshape", latent, graph.shape(-1, config.columns, 1, config.decoder_sides[0]))
        value = graph.node("ConvTranspose", value, kernel, bias, pads=BESIDE)
    else:
        value = graph.node("Gemm", latent, kernel, bias, transB=1)
    value = _activate(graph, value, config) if config.activate_dense else value
    side, last = config.decoder_sides[0], len(config.up) - 1
    value = graph.node("Reshape", value, graph.shape(-1, config.up[0].inputs, side, side))
    for index, layer in enumerate(config.up):
        weights, offsets = _folded(vae, "decoder", index, config)
        value = graph.node("ConvTranspose", value, graph.weight(weights), graph.weight(offsets), **_window(layer))
        value = graph.node("Sigmoid", value) if index == last else _activate(graph, value, config)
    value = graph.node("Mul", value, graph.numbers(255))
    value = graph.node("Cast", graph.node("Round", value), to=TensorProto.UINT8)
    value = graph.node("Transpose", value, perm=[0, 2, 3, 1])
    graph.add_output(value, "picture", TensorProto.UINT8, config.picture, config.picture, 3)
    return graph.build()


def export_policy(
    vae: Weights, rnn: Weights, vae_config: VAEConfig, rnn_config: MDNRNNConfig, actions: Continuous,
    ranges: Ranges | None = None,
) -> bytes:  # fmt: skip
    """Export one policy step: `picture`, `parameters` and `state` to `action`, `next_state` and `latent`.

    The controller acts on (z_t, h_t), then the MDN-RNN advances on (z_t, a_t). Each row of `parameters` (N, size) is a
    linear controller, packed as in `common.artifacts.controller.ControllerShape`. z is the encoder's mean, h the first
    columns of `state` (N, state). With `ranges` the products of encoder and LSTM are of eight-bit integers.
    """
    graph, count = GraphBuilder("policy"), rnn_config.actions
    size = count * (rnn_config.latent + rnn_config.hidden + 1)
    picture = graph.add_input("picture", TensorProto.UINT8, vae_config.picture, vae_config.picture, 3)
    parameters = graph.add_input("parameters", TensorProto.FLOAT, size)
    state = graph.add_input("state", TensorProto.FLOAT, rnn_config.state)
    recurrent = RecurrentGraph(graph, state, rnn, rnn_config, ranges)
    latent = _encode(graph, picture, vae, vae_config, ranges)("mu")
    weights, biases = graph.split(parameters, size - count, count)
    weights = graph.node("Reshape", weights, graph.shape(-1, count, rnn_config.latent + rnn_config.hidden))
    features = graph.join(latent, recurrent.hidden)
    ordered = ranges is not None and count > 1
    action = squash(graph, _layer(graph, features, weights, biases, ordered=ordered), actions)
    recurrent.advance(latent, action)
    graph.add_output(action, "action", TensorProto.FLOAT, count)
    graph.add_output(recurrent.next_state(), "next_state", TensorProto.FLOAT, rnn_config.state)
    graph.add_output(latent, "latent", TensorProto.FLOAT, rnn_config.latent)
    return graph.build()


def export_controller(actions: Continuous, *, hidden: bool, ordered: bool = False) -> bytes:
    """Export controllers of any size, one per row: `features` (N, F) to `action` (N, A).

    Inputs `weights0` (N, A, F) and `biases0` (N, A). With a `hidden` layer of K units: `weights0` (N, K, F), `biases0`
    (N, K), `weights1` (N, A, K), `biases1` (N, A).

    If `ordered`, all processors add the products of a linear controller with several outputs in the same order. A sum
    with one output would have another order alone than in a batch.
    """
    graph, kind = GraphBuilder("controller"), TensorProto.FLOAT
    value, sizes = graph.add_input("features", kind, "F"), ["F", "K", "A"] if hidden else ["F", "A"]
    for index, (before, after) in enumerate(pairwise(sizes)):
        weights = graph.add_input(f"weights{index}", kind, after, before)
        biases = graph.add_input(f"biases{index}", kind, after)
        value = _layer(graph, value, weights, biases, ordered=ordered and not hidden and actions.outputs > 1)
    graph.add_output(squash(graph, value, actions), "action", kind, actions.outputs)
    return graph.build()


def _encode(
    graph: GraphBuilder, picture: str, vae: Weights, config: VAEConfig, ranges: Ranges | None
) -> Callable[[str], str]:
    """Add the encoder's convolutions; the result adds the layer `mu` or `logvar` to them."""
    value, layers = graph.node("Transpose", picture, perm=[0, 3, 1, 2]), range(len(config.down))
    if ranges is None:
        value = graph.node("Cast", value, to=TensorProto.FLOAT)
        for index in layers:
            value = _convolve(graph, value, vae, config, index)
        if config.columns:
            return lambda name: _convolve_columns(graph, value, vae, config, name)
        flat = graph.node("Reshape", value, graph.shape(-1, config.flat))
        return lambda name: graph.linear(flat, vae[f"{name}.weight"].T, vae[f"{name}.bias"])
    step = PIXEL_STEP
    for index in layers:
        steps, window = (step, ranges.step_of(index)), _window(config.down[index])
        value = add_convolution(graph, value, *_folded(vae, "encoder", index, config), steps, window)
        step = steps[1]
    whole = graph.node("Reshape", value, graph.shape(-1, config.flat))
    return lambda name: add_product(graph, whole, *_as_product(vae, config, name), step)


def _convolve_columns(graph: GraphBuilder, value: str, vae: Weights, config: VAEConfig, name: str) -> str:
    """Add a layer that gives each column its latents."""
    kernel, bias = (graph.constant(vae[f"{name}.{each}"]) for each in ("weight", "bias"))
    return graph.node("Reshape", graph.node("Conv", value, kernel, bias, pads=BESIDE), graph.shape(-1, config.latent))


def _as_product(vae: Weights, config: VAEConfig, name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The layer `mu` or `logvar` as a kernel (inputs, outputs) and a bias."""
    kernel, bias = vae[f"{name}.weight"], vae[f"{name}.bias"]
    if not config.columns:
        return kernel.T, bias
    count, channels, side, _ = kernel.shape
    product = np.zeros((channels, side, side + 2, count, side), np.float32)  # with a column more at both edges
    for column in range(side):
        product[:, :, column : column + 3, :, column] = kernel.transpose(1, 2, 3, 0)
    return product[:, :, 1:-1].reshape(config.flat, config.latent), np.repeat(bias, side)


def _convolve(graph: GraphBuilder, value: str, vae: Weights, config: VAEConfig, index: int) -> str:
    """Add a convolution of the encoder and its activation; the first one divides by 255."""
    kernel, bias = _folded(vae, "encoder", index, config)
    kernel = (kernel.astype(np.float64) / 255).astype(np.float32) if index == 0 else kernel
    value = graph.node("Conv", value, graph.constant(kernel), graph.constant(bias), **_window(config.down[index]))
    return _activate(graph, value, config)


def _window(layer: ConvolutionLayer) -> dict[str, Any]:
    pads = {"pads": [layer.before] * 2 + [layer.after] * 2} if layer.after else {}
    return {"strides": [layer.stride] * 2} | pads


def _activate(graph: GraphBuilder, value: str, config: VAEConfig) -> str:
    if config.activation == "relu":
        return graph.node("Relu", value)
    return graph.node("LeakyRelu", value, alpha=LEAK)


def _folded(vae: Weights, part: str, layer: int, config: VAEConfig) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Kernel and bias of a layer with its batch normalisation folded in."""
    index = layer * config.modules_a_layer
    kernel, bias = vae[f"{part}.{index}.weight"], vae[f"{part}.{index}.bias"]
    norm = f"{part}.{index + 1}"
    if f"{norm}.running_var" not in vae:
        return kernel, bias
    scale = vae[f"{norm}.weight"] / np.sqrt(vae[f"{norm}.running_var"] + EPSILON)
    outputs = 0 if part == "encoder" else 1  # the kernel's output axis, which torch swaps in transposed convolutions
    kernel = kernel * np.expand_dims(scale, [axis for axis in range(4) if axis != outputs])
    return kernel, (bias - vae[f"{norm}.running_mean"]) * scale + vae[f"{norm}.bias"]


def _layer(graph: GraphBuilder, features: str, weights: str, biases: str, *, ordered: bool = False) -> str:
    """Add a tanh layer in which each row has its own weights; if `ordered`, its sums have the same order everywhere."""
    if ordered:
        products = graph.node("Mul", weights, graph.node("Unsqueeze", features, graph.shape(1)))
        # Only sums over the first axis have one order. The reshaping keeps the shape, and the runtime from undoing it.
        moved = graph.node("Reshape", graph.node("Transpose", products, perm=[2, 0, 1]), graph.shape(0, 0, 0))
        value = graph.node("ReduceSum", moved, graph.shape(0), keepdims=0)
    else:
        product = graph.node("MatMul", weights, graph.node("Unsqueeze", features, graph.shape(2)))
        value = graph.node("Squeeze", product, graph.shape(2))
    return graph.node("Tanh", graph.node("Add", value, biases))


def squash(graph: GraphBuilder, squashed: str, actions: Continuous) -> str:
    """Scale tanh outputs to the ranges of `actions`; clipping at an unreachable bound is left out."""
    scale, shift, low, high = (
        np.array(each, np.float32) for each in (actions.scale, actions.shift, actions.low, actions.high)
    )
    moved = graph.node("Add", graph.node("Mul", squashed, graph.constant(scale)), graph.constant(shift))
    if (shift - scale < low).any():
        moved = graph.node("Max", moved, graph.constant(low))
    if (shift + scale > high).any():
        moved = graph.node("Min", moved, graph.constant(high))
    return str(moved)
