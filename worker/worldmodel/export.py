"""ONNX graphs of the frozen world model, written node by node from its weights.

Written by hand rather than traced, because the bits of a row must not depend on its batch: weights are constant
initializers, and nothing gathers, loops or reshapes by a traced batch size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from worker.worldmodel.mdnrnn import MDNRNNConfig
from worker.worldmodel.vae import VAEConfig

Weights = Mapping[str, NDArray[np.float32]]
OPSET = 17
IR_VERSION = 8
SIZE = 64


class GraphBuilder:
    """Collects nodes and constants; each method returns the name of what it made."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []

    def take(self, name: str, kind: int, *shape: int) -> str:
        """An input of `kind` and shape `(N, *shape)`."""
        self._inputs.append(helper.make_tensor_value_info(name, kind, ["N", *shape]))
        return name

    def give(self, value: str, name: str, kind: int, *shape: int) -> None:
        """An output of `kind` and shape `(N, *shape)`."""
        for node in self._nodes:  # renamed where it is made and used: an Identity node would cost a copy
            for names in (node.input, node.output):
                names[:] = [name if each == value else each for each in names]
        self._outputs.append(helper.make_tensor_value_info(name, kind, ["N", *shape]))

    def constant(self, array: NDArray[Any]) -> str:
        """A weight."""
        name = f"c{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def node(self, operator: str, *inputs: str, outputs: int = 1, **attributes: Any) -> Any:
        """One operator; a tuple of names where it has several outputs."""
        names = [f"n{len(self._nodes)}_{index}" for index in range(outputs)]
        self._nodes.append(helper.make_node(operator, list(inputs), names, **attributes))
        return names[0] if outputs == 1 else tuple(names)

    def shape(self, *sizes: int) -> str:
        """A shape to reshape to."""
        return self.constant(np.array(sizes, dtype=np.int64))

    def build(self) -> bytes:
        """The checked model."""
        graph = helper.make_graph(self._nodes, self._name, self._inputs, self._outputs, self._constants)
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION, producer_name="dreamfleet")
        onnx.checker.check_model(model, full_check=True)
        data: bytes = model.SerializeToString(deterministic=True)
        return data


def export_encoder(vae: Weights, config: VAEConfig) -> bytes:
    """`picture` (N, 64, 64, 3) uint8 to `mu` and `logvar` (N, latent)."""
    graph = GraphBuilder("encoder")
    flat = _encode(graph, graph.take("picture", TensorProto.UINT8, SIZE, SIZE, 3), vae, config)
    for name in ("mu", "logvar"):
        graph.give(_linear(graph, flat, vae, name), name, TensorProto.FLOAT, config.latent)
    return graph.build()


def export_decoder(vae: Weights, config: VAEConfig) -> bytes:
    """`latent` (N, latent) to `picture` (N, 64, 64, 3) uint8; weights in half precision, sums in single."""
    graph = GraphBuilder("decoder")
    half = {name: array.astype(np.float16) for name, array in vae.items()}

    def weight(name: str) -> str:
        return str(graph.node("Cast", graph.constant(half[name]), to=TensorProto.FLOAT))

    latent = graph.take("latent", TensorProto.FLOAT, config.latent)
    value = graph.node("Gemm", latent, weight("dense.weight"), weight("dense.bias"), transB=1)
    value = graph.node("Reshape", value, graph.shape(-1, 4 * config.channels[-1], 1, 1))
    for layer in (0, 2, 4, 6):
        kernel, bias = weight(f"decoder.{layer}.weight"), weight(f"decoder.{layer}.bias")
        value = graph.node("ConvTranspose", value, kernel, bias, strides=[2, 2])
        value = graph.node("Sigmoid" if layer == 6 else "Relu", value)
    value = graph.node("Mul", value, graph.constant(np.array(255, np.float32)))
    value = graph.node("Cast", graph.node("Round", value), to=TensorProto.UINT8)
    value = graph.node("Transpose", value, perm=[0, 2, 3, 1])
    graph.give(value, "picture", TensorProto.UINT8, SIZE, SIZE, 3)
    return graph.build()


def export_policy(vae: Weights, rnn: Weights, vae_config: VAEConfig, rnn_config: MDNRNNConfig) -> bytes:
    """One step: picture, controllers and state to action and next state.

    The controller acts on (z_t, h_t), then the LSTM advances on (z_t, a_t). `parameters` (N, size) holds a controller
    a row, packed as `common.controller.ControllerShape` says; z is the encoder's mean.
    """
    graph = GraphBuilder("policy")
    hidden_size, actions = rnn_config.hidden, rnn_config.actions
    size = actions * (rnn_config.latent + hidden_size + 1)
    picture = graph.take("picture", TensorProto.UINT8, SIZE, SIZE, 3)
    parameters = graph.take("parameters", TensorProto.FLOAT, size)
    hidden = graph.take("hidden", TensorProto.FLOAT, hidden_size)
    cell = graph.take("cell", TensorProto.FLOAT, hidden_size)
    latent = _linear(graph, _encode(graph, picture, vae, vae_config), vae, "mu")
    action = _act(graph, parameters, graph.node("Concat", latent, hidden, axis=1), rnn_config)
    next_hidden, next_cell = _advance(graph, [latent, action, hidden], cell, rnn, hidden_size)
    graph.give(action, "action", TensorProto.FLOAT, actions)
    graph.give(next_hidden, "next_hidden", TensorProto.FLOAT, hidden_size)
    graph.give(next_cell, "next_cell", TensorProto.FLOAT, hidden_size)
    graph.give(latent, "latent", TensorProto.FLOAT, rnn_config.latent)
    return graph.build()


def _encode(graph: GraphBuilder, picture: str, vae: Weights, config: VAEConfig) -> str:
    """Convolutions over the picture; its scale of 1/255 is folded into the first."""
    value = graph.node("Cast", graph.node("Transpose", picture, perm=[0, 3, 1, 2]), to=TensorProto.FLOAT)
    for layer in (0, 2, 4, 6):
        kernel = vae[f"encoder.{layer}.weight"]
        kernel = (kernel.astype(np.float64) / 255).astype(np.float32) if layer == 0 else kernel
        bias = graph.constant(vae[f"encoder.{layer}.bias"])
        value = graph.node("Relu", graph.node("Conv", value, graph.constant(kernel), bias, strides=[2, 2]))
    return str(graph.node("Reshape", value, graph.shape(-1, 4 * config.channels[-1])))


def _linear(graph: GraphBuilder, value: str, weights: Weights, name: str) -> str:
    kernel = graph.constant(weights[f"{name}.weight"].T)
    return str(graph.node("Gemm", value, kernel, graph.constant(weights[f"{name}.bias"])))


def _act(graph: GraphBuilder, parameters: str, features: str, config: MDNRNNConfig) -> str:
    """The controller of each row on its own features: tanh; gas (tanh + 1) / 2; brake clip(tanh, 0, 1)."""
    actions, size = config.actions, config.latent + config.hidden
    split = graph.shape(actions * size, actions)
    weights, biases = graph.node("Split", parameters, split, outputs=2, axis=1)
    weights = graph.node("Reshape", weights, graph.shape(-1, actions, size))
    product = graph.node("MatMul", weights, graph.node("Unsqueeze", features, graph.shape(2)))
    squashed = graph.node("Tanh", graph.node("Add", graph.node("Squeeze", product, graph.shape(2)), biases))
    scale, shift = np.array([1, 0.5, 1], np.float32), np.array([0, 0.5, 0], np.float32)
    low = np.array([-1, 0, 0], np.float32)
    moved = graph.node("Add", graph.node("Mul", squashed, graph.constant(scale)), graph.constant(shift))
    return str(graph.node("Max", moved, graph.constant(low)))


def _advance(graph: GraphBuilder, inputs: Sequence[str], cell: str, rnn: Weights, hidden_size: int) -> tuple[str, str]:
    """One LSTM step as one matrix product; torch's gates i, f, g, o become i, f, o, g for one Sigmoid of three."""
    order = np.concatenate([np.arange(hidden_size) + gate * hidden_size for gate in (0, 1, 3, 2)])
    kernel = np.concatenate([rnn["lstm.weight_ih_l0"], rnn["lstm.weight_hh_l0"]], axis=1)[order].T
    bias = (rnn["lstm.bias_ih_l0"] + rnn["lstm.bias_hh_l0"])[order]
    gates = graph.node("Gemm", graph.node("Concat", *inputs, axis=1), graph.constant(kernel), graph.constant(bias))
    squashed, candidate = graph.node("Split", gates, graph.shape(3 * hidden_size, hidden_size), outputs=2, axis=1)
    opened = graph.node("Sigmoid", squashed)
    enter, forget, leave = graph.node("Split", opened, graph.shape(*[hidden_size] * 3), outputs=3, axis=1)
    kept = graph.node("Mul", forget, cell)
    next_cell = graph.node("Add", kept, graph.node("Mul", enter, graph.node("Tanh", candidate)))
    next_hidden = graph.node("Mul", leave, graph.node("Tanh", next_cell))
    return next_hidden, next_cell
