"""Eight-bit encoders and LSTMs: their weights and inputs are integers, whose products have the same sum in any order.

An input has eight bits without a sign, a weight seven bits with one: the sums of two products, which some processors
form in sixteen bits, then never overflow. Where a sum becomes a single-precision number, its scale is so short that the
product is exact: processors that add the bias in the same instruction then round as those that do not.

A bundle that exists holds its own graphs. Pages: determinism.md, measurements.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.worldmodel.onnx_graph import RUNTIME, GraphBuilder

HIGHEST_WEIGHT = 63  # so that processors are one class: docs/how-to/mixed-hosts.md
CENTRE = 128  # an LSTM's input is an integer from -127 to 127, plus 128
PIXEL_STEP = np.float32(1 / 255)  # of a picture, whose bytes are a convolution's inputs as they are
INPUT_STEP = np.float32(1 / 127)  # of an input that is divided by its range
HIGHEST_OUTPUT = 255  # of a convolution, whose outputs are not negative
HIGHEST_BIAS = np.float32(2**30)  # a convolution's, as an integer of 32 bits
MANTISSA = 24  # binary digits of a single-precision number

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Ranges:
    """The largest values that are not cut, from which the steps between integers follow."""

    layers: tuple[float, ...]  # of each convolution's outputs
    inputs: tuple[float, ...] = ()  # magnitudes of the LSTM's inputs; empty: it computes in single precision

    def step_of(self, layer: int) -> np.float32:
        """The step between a convolution's outputs."""
        return np.float32(self.layers[layer] / HIGHEST_OUTPUT)


def add_convolution(
    graph: GraphBuilder, value: str, kernel: Floats, bias: Floats, steps: tuple[np.float32, np.float32],
    window: dict[str, Any],
) -> str:  # fmt: skip
    """Add a convolution and its rectifier to `value`: integers of the first step become integers of the second."""
    before, after = (graph.constant(np.array(step)) for step in steps)
    least = np.abs(bias) / (steps[0] * HIGHEST_BIAS)
    scales: Floats = np.maximum(_steps(kernel.reshape(len(kernel), -1).T), least).astype(np.float32)
    weights, zeros = _round_keeping_sums(kernel / scales[:, None, None, None]), np.zeros(len(kernel), np.int8)
    whole_bias = np.rint(bias / (scales.astype(np.float64) * steps[0])).astype(np.int32)
    factor = [graph.constant(each) for each in (weights, scales, zeros)]
    inputs = [value, before, _zero(graph), *factor, after, _zero(graph), graph.constant(whole_bias)]
    return graph.node("QLinearConv", *inputs, **window)


def round_inputs(graph: GraphBuilder, value: str, ranges: Floats) -> str:
    """Round the columns of `value`, whose magnitudes are up to `ranges`, to integers for `add_input_product`."""
    scaled = graph.node("Mul", value, graph.constant(1 / ranges))
    return graph.node("QuantizeLinear", scaled, graph.constant(np.array(INPUT_STEP)), _centre(graph))


def add_product(graph: GraphBuilder, value: str, kernel: Floats, bias: Floats, step: np.float32) -> str:
    """Multiply `value`, integers of this step, by `kernel` (inputs, outputs), and add `bias` in single precision.

    A weight is two integers, the second of what the first leaves: with one, a controller fell from 903 points to 880.
    """
    return _add_product(graph, [value], kernel, bias, step)


def add_input_product(graph: GraphBuilder, value: str, kernel: Floats, bias: Floats, ranges: Floats) -> str:
    """The same for a value of `round_inputs`."""
    return _add_product(graph, [value, _centre(graph)], kernel * ranges[:, None], bias, INPUT_STEP)


def add_exponential(graph: GraphBuilder, value: str) -> str:
    """Raise e to `value`, up to 2^23, by a sigmoid: processors agree on it to the bit, and on the operator Exp not."""
    share = graph.node("Sigmoid", value)
    above_one = graph.constant(np.nextafter(np.ones((), np.float32), np.float32(2)))
    return graph.node("Div", share, graph.node("Sub", above_one, share))


def round_weights_exactly(kernel: Floats, step: np.float32, *, centred: bool) -> tuple[NDArray[np.int8], Floats]:
    """The integers of a kernel (inputs, outputs), and the scales of its sums, whose products with them are exact.

    The inputs are integers of this `step`, from -128 to 127 if `centred`, else from 0 to 255.
    """
    steps = _steps(kernel)
    weights = np.rint(kernel / steps)
    above, below = (np.maximum(sign * weights.astype(np.int64), 0).sum(axis=0) for sign in (1, -1))
    largest = CENTRE * (above + below) if centred else HIGHEST_OUTPUT * np.maximum(above, below)
    digits = np.maximum(MANTISSA - np.frexp(largest)[1], 1)
    part, exponent = np.frexp(steps.astype(np.float64) * step)
    scales = np.ldexp(np.ceil(np.ldexp(part, digits)), exponent - digits)  # larger ones: no weight leaves its range
    return np.rint(kernel / (scales / step)).astype(np.int8), scales.astype(np.float32)


def _add_product(graph: GraphBuilder, factor: Sequence[str], kernel: Floats, bias: Floats, step: np.float32) -> str:
    """Add the product, with the bias, and the product of what the first integers leave of the weights."""
    value, *centre = factor
    one, no_zero, parts = graph.numbers(1), "", list[str]()
    for offset in (bias, np.zeros_like(bias)):
        weights, scales = round_weights_exactly(kernel, step, centred=bool(centre))
        kernel = kernel - weights * (scales / step)
        constants = [graph.constant(each) for each in (weights, scales, offset)]
        # The runtime's own operator is MatMulInteger, Cast, Mul and Add in one: the same bits, in less time.
        inputs = [value, constants[0], one, constants[1], *(centre or [no_zero]), no_zero, constants[2]]
        parts.append(graph.node("MatMulIntegerToFloat", *inputs, domain=RUNTIME))
    return graph.node("Add", *parts)


def _zero(graph: GraphBuilder) -> str:
    return graph.constant(np.array(0, np.uint8))


def _centre(graph: GraphBuilder) -> str:
    return graph.constant(np.array(CENTRE, np.uint8))


def _steps(kernel: Floats) -> Floats:
    """The step between the integers of each output of a kernel (inputs, outputs)."""
    steps: Floats = (np.abs(kernel).max(axis=0) / HIGHEST_WEIGHT).astype(np.float32)
    steps[steps == 0] = 1
    return steps


def _round_keeping_sums(kernel: Floats) -> NDArray[np.int8]:
    """The integers of a convolution's kernel (outputs, inputs, rows, columns), with about the sum of each window.

    Neighbours in a picture are alike, so what rounding takes from a window's sum would move its output everywhere: that
    was three quarters of a latent's error.
    """
    exact = kernel.reshape(-1, kernel.shape[2] * kernel.shape[3])
    rounded = np.rint(exact)
    lost = exact - rounded
    missing = np.rint(lost.sum(axis=1, keepdims=True))
    order = np.argsort(-lost * np.sign(missing), axis=1, kind="stable")  # first the weights that lost most
    rank = np.argsort(order, axis=1, kind="stable")
    whole = rounded + np.sign(missing) * (rank < np.abs(missing))
    found: NDArray[np.int8] = whole.reshape(kernel.shape).astype(np.int8)
    return found
