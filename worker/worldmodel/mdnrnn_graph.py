"""The MDN-RNN's step as ONNX nodes, for the policy's and the dream's graph, and the export of the dream."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto

from dreamfleet.worker.worldmodel.eight_bits import Ranges, add_exponential, add_input_product, round_inputs
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.onnx_graph import GraphBuilder

Weights = Mapping[str, NDArray[np.float32]]


class RecurrentGraph:
    """The LSTM, and the attention before it, in a graph with an input `state` (N, state)."""

    def __init__(
        self, graph: GraphBuilder, state: str, rnn: Weights, config: MDNRNNConfig, ranges: Ranges | None = None
    ) -> None:
        self._graph, self._rnn, self._config = graph, rnn, config
        self._ranges = () if ranges is None else ranges.inputs
        self._step = config.latent + config.actions
        parts = graph.split(
            state, config.hidden, config.hidden, int(config.previous_reward), config.window * self._step
        )
        self.hidden, self._cell, self.previous, self._window = parts
        self.attention = ""  # weights (N, window, 1) of the last step

    def advance(self, latent: str, action: str) -> str:
        """Add one step; return the next hidden state, which is `hidden` from now on."""
        graph, step = self._graph, window_input(self._graph, latent, action, self._config)
        inputs = [latent, action, self.previous]
        if self._config.window:
            _, kept = graph.split(self._window, self._step, (self._config.window - 1) * self._step)
            self._window = graph.join(kept, step)
            inputs.append(self._attend())
        self.hidden, self._cell = lstm(graph, inputs, self.hidden, self._cell, self._rnn, self._ranges)
        return self.hidden

    def next_state(self, previous: str = "") -> str:
        """The state after `advance`, laid out as in `MDNRNNConfig.state`; `previous` is the reward head's label."""
        return self._graph.join(self.hidden, self._cell, previous or self.previous, self._window)

    def _attend(self) -> str:
        graph, rnn, window = self._graph, self._rnn, self._config.window
        seen = graph.node("Reshape", self._window, graph.shape(-1, window, self._step))
        keys = graph.node("MatMul", seen, graph.constant(rnn["keys.weight"].T))
        keys = graph.node("Add", keys, graph.constant(rnn["keys.bias"]))
        query = graph.node("Unsqueeze", graph.linear(self.hidden, rnn["query.weight"].T), graph.shape(1))
        scores = graph.node("Tanh", graph.node("Add", keys, query))
        scores = graph.node("MatMul", scores, graph.constant(rnn["score.weight"].T))
        self.attention = graph.node("Softmax", scores, axis=1)
        weighted = graph.node("Mul", self.attention, seen)
        return graph.node("ReduceSum", weighted, graph.shape(1), keepdims=0)


def lstm(
    graph: GraphBuilder, inputs: Sequence[str], hidden: str, cell: str, weights: Weights, ranges: Sequence[float] = ()
) -> tuple[str, str]:
    """Add a step of an LSTM with torch's names of `weights`; return its next hidden and cell state.

    Each gate has its own matrix product: splitting a common one costs more copies than it saves (5 % of a step). With
    the `ranges` of its inputs it is a product of eight-bit integers.
    """
    size = weights["lstm.weight_hh_l0"].shape[1]
    kernel = np.concatenate([weights["lstm.weight_ih_l0"], weights["lstm.weight_hh_l0"]], axis=1)
    bias = weights["lstm.bias_ih_l0"] + weights["lstm.bias_hh_l0"]
    rows = [slice(gate * size, (gate + 1) * size) for gate in range(4)]
    joined = graph.join(*inputs, hidden)
    widths = np.array([*ranges, *[1.0] * size], np.float32)  # the hidden state is below 1
    rounded = round_inputs(graph, joined, widths) if ranges else ""

    def gate_product(gate: slice) -> str:
        if ranges:
            return add_input_product(graph, rounded, kernel[gate].T, bias[gate], widths)
        return graph.linear(joined, kernel[gate].T, bias[gate])

    enter, forget, candidate, leave = (
        graph.node(kind, gate_product(gate))
        for kind, gate in zip(("Sigmoid", "Sigmoid", "Tanh", "Sigmoid"), rows, strict=True)
    )
    kept = graph.node("Mul", forget, cell)
    cell = graph.node("Add", kept, graph.node("Mul", enter, candidate))
    return graph.node("Mul", leave, graph.node("Tanh", cell)), cell


def window_input(graph: GraphBuilder, latent: str, action: str, config: MDNRNNConfig) -> str:
    """The entry `(N, latent + actions)` of the attention's window; empty without one."""
    return graph.join(latent, action) if config.window else ""


def export_dream(rnn: Weights, config: MDNRNNConfig, ranges: Ranges | None = None) -> bytes:
    """Export a step of the dream; with `ranges` the products of LSTM and heads are of eight-bit integers.

    Inputs: `latent` (N, latent), `action` (N, actions), `state` (N, state), the random numbers `uniform` and `normal`
    (N, latent), `temperature` (1,), and with dropout `mask` (N, hidden), a factor of the LSTM's output. Outputs:
    `next_latent`, `next_state`, for existing heads `reward` (probability or value) and `done` (N,), and with attention
    `attention` (N, window).

    Sampling (Ha & Schmidhuber 2018): log weights divided by the temperature, deviations times its square root. The
    mixture is the first whose cumulative weight exceeds `uniform`, selected by `Where` nodes rather than Gather. Of a
    joint mixture the first number of each row draws for all latents.
    """
    graph, kind = GraphBuilder("dream"), TensorProto.FLOAT
    latent, action = graph.add_input("latent", kind, config.latent), graph.add_input("action", kind, config.actions)
    state = graph.add_input("state", kind, config.state)
    uniform, normal = graph.add_input("uniform", kind, config.latent), graph.add_input("normal", kind, config.latent)
    temperature = graph.add_scalar_input("temperature")
    recurrent = RecurrentGraph(graph, state, rnn, config, ranges)
    previous = recurrent.previous
    hidden = recurrent.advance(latent, action)
    if config.dropout:
        hidden = graph.node("Mul", hidden, graph.add_input("mask", kind, config.hidden))
    if config.columns:
        heads = _column_heads(graph, latent, graph.join(action, previous), hidden, rnn, config)
    else:
        heads = _heads(graph, hidden, rnn, config, ranges)
    columns = graph.split(
        heads, *[config.weighted] * config.mixtures, *[config.latent] * (2 * config.mixtures),
        int(config.has_reward_head), int(config.done),
    )  # fmt: skip
    *mixtures, reward, done = columns
    if config.joint:
        uniform, _ = graph.split(uniform, config.weighted, config.latent - config.weighted)
    if config.joint and config.columns:
        uniform = graph.join(*[uniform] * config.columns)
        mixtures[: config.mixtures] = (graph.join(*[each] * config.columns) for each in mixtures[: config.mixtures])
    exponential = add_exponential if _is_rounded(ranges) else lambda graph, value: graph.node("Exp", value)
    mean, deviation = _select_mixture(graph, mixtures, uniform, temperature, exponential)
    noise = graph.node("Mul", normal, graph.node("Sqrt", temperature))  # docs/explanation/dreams.md
    spread = graph.node("Mul", exponential(graph, deviation), noise)
    graph.add_output(graph.node("Add", mean, spread), "next_latent", kind, config.latent)
    label = _dreamt_reward_label(graph, reward, config) if config.previous_reward else ""
    graph.add_output(recurrent.next_state(label), "next_state", kind, config.state)
    if recurrent.attention:
        weights = graph.node("Squeeze", recurrent.attention, graph.shape(2))
        graph.add_output(weights, "attention", kind, config.window)
    for name, head in (("reward", reward), ("done", done)):
        if head:
            value = head if name == "reward" and config.reward == "value" else graph.node("Sigmoid", head)
            graph.add_output(graph.node("Squeeze", value, graph.shape(1)), name, kind)
    return graph.build()


def _heads(graph: GraphBuilder, hidden: str, rnn: Weights, config: MDNRNNConfig, ranges: Ranges | None) -> str:
    order = mixture_major_order(config)
    kernel, bias = rnn["heads.weight"][order].T, rnn["heads.bias"][order]
    if _is_rounded(ranges):
        widths = np.full(config.hidden, 1 / (1 - config.dropout), np.float32)  # the hidden state is below 1
        return add_input_product(graph, round_inputs(graph, hidden, widths), kernel, bias, widths)
    # In half precision: the bundle holds the LSTM twice already, and its size is limited.
    return graph.node("Gemm", hidden, graph.weight(kernel), graph.constant(bias))


def _column_heads(
    graph: GraphBuilder, latent: str, others: str, hidden: str, rnn: Weights, config: MDNRNNConfig
) -> str:
    """`ColumnHeads`, with its mixtures in the order of `mixture_major_order`; in single precision with any ranges."""

    def convolve(value: str, name: str, pad: int) -> str:
        kernel, bias = (graph.constant(rnn[f"heads.{name}.{each}"]) for each in ("weight", "bias"))
        return graph.node("Conv", value, kernel, bias, pads=[pad, pad])

    units, rest = graph.split(hidden, config.units_in_columns, config.hidden - config.units_in_columns)
    parts = ((latent, config.columns), (units, config.column_units))
    seen = graph.join(*(graph.node("Reshape", each, graph.shape(-1, count, config.side)) for each, count in parts))
    near = convolve(seen, "near", 2)
    kernel, bias = rnn["heads.everywhere.weight"].T, rnn["heads.everywhere.bias"]
    everywhere = graph.linear(graph.join(others, rest), kernel, bias)
    placed = graph.node("Reshape", everywhere, graph.shape(-1, len(bias) // config.side, config.side))
    value = graph.node("Relu", graph.node("Add", near, placed))
    value = graph.node("Relu", convolve(value, "second", 1))
    size = config.mixtures * sum(config.rows)
    mixtures = graph.node("Reshape", convolve(value, "mixtures", 0), graph.shape(-1, size))
    if config.outputs == size:
        return mixtures
    kernel = rnn["heads.others.weight"].T
    flat = graph.node("Reshape", value, graph.shape(-1, len(kernel)))
    return graph.join(mixtures, graph.linear(flat, kernel, rnn["heads.others.bias"]))


def _is_rounded(ranges: Ranges | None) -> bool:
    return ranges is not None and bool(ranges.inputs)


def mixture_major_order(config: MDNRNNConfig) -> NDArray[Any]:
    """The heads' rows in the order (kind, mixture, latent) instead of (kind, latent, mixture), to slice mixtures."""
    rows, start = [], 0
    for latents in config.rows:
        count = latents * config.mixtures
        rows.append(start + np.arange(count).reshape(latents, config.mixtures).T.ravel())
        start += count
    return np.concatenate([*rows, np.arange(start, config.outputs)])


def _select_mixture(
    graph: GraphBuilder, mixtures: Sequence[str], uniform: str, temperature: str,
    exponential: Callable[[GraphBuilder, str], str],
) -> tuple[str, str]:  # fmt: skip
    """Mean and log deviation (N, latent) of the mixture selected by `uniform`; `mixtures` are the heads' columns."""
    count = len(mixtures) // 3
    logits, means, deviations = mixtures[:count], mixtures[count : 2 * count], mixtures[2 * count :]
    if count == 1:
        return means[0], deviations[0]
    highest = graph.node("Max", *logits)
    cumulated: list[str] = []
    for each in logits:
        weight = exponential(graph, graph.node("Div", graph.node("Sub", each, highest), temperature))
        cumulated.append(graph.node("Add", cumulated[-1], weight) if cumulated else weight)
    point = graph.node("Mul", uniform, cumulated[-1])
    mean, deviation = means[0], deviations[0]
    for index in range(1, count):
        beyond = graph.node("GreaterOrEqual", point, cumulated[index - 1])
        mean = graph.node("Where", beyond, means[index], mean)
        deviation = graph.node("Where", beyond, deviations[index], deviation)
    return mean, deviation


def _dreamt_reward_label(graph: GraphBuilder, reward: str, config: MDNRNNConfig) -> str:
    """The previous reward of a dream's next step: the predicted value, or the likelier label."""
    if config.reward == "value":
        return reward
    positive = graph.node("Greater", reward, graph.numbers(0))
    return graph.node("Cast", positive, to=TensorProto.FLOAT)
