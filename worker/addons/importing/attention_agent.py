"""AttentionAgent (Google's brain-tokyo-workshop) of Take Cover: `model.npz`, as a trained agent.

The file has one array `params` (3633,): the parameters of each layer in turn, a layer's by name in alphabetical order.
The layers are queries and keys (4 of the 147 numbers of a patch: row, column, colour), an LSTM of 16 units, and the
output.
"""

from pathlib import Path

import numpy as np
from onnx import TensorProto

from dreamfleet.common.artifacts.actions import one_hot
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.archives import read_arrays
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.worlds.shipped import WORLDS
from dreamfleet.worker.addons.importing.json_weights import Weights, check_range
from dreamfleet.worker.addons.importing.sources import AGENT_ARRAY, AGENT_LIMITS
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.mdnrnn_graph import lstm
from dreamfleet.worker.worldmodel.onnx_graph import GraphBuilder
from dreamfleet.worker.worlds.trained_agent import AgentManifest, TrainedAgent

SOURCE = "google/brain-tokyo-workshop, AttentionAgent"
PICTURES = "screen-96"  # which only that task has
SIDE, PATCH, STRIDE, CHOSEN = 96, 7, 4, 10
UNITS = 16
PLACES = (SIDE - PATCH) // STRIDE + 1  # of patches in a row or a column
BAR = 0.3333  # outputs beyond it move the player
SHAPES = {
    "query.bias": (4,), "query.weight": (4, PATCH, PATCH, 3),
    "key.bias": (4,), "key.weight": (4, PATCH, PATCH, 3),
    "lstm.bias_hh_l0": (4 * UNITS,), "lstm.bias_ih_l0": (4 * UNITS,),
    "lstm.weight_hh_l0": (4 * UNITS, UNITS), "lstm.weight_ih_l0": (4 * UNITS, 2 * CHOSEN),
    "out.bias": (1,), "out.weight": (1, UNITS),
}  # fmt: skip


class _Graph(GraphBuilder):
    def most(self, value: str, count: int) -> str:
        """The columns `(N, count)` of the largest numbers of each row, the largest first."""
        return self._add("TopK", [value, self.shape(count)], 2, axis=1)[1]


def import_attention_agent(path: Path) -> TrainedAgent:
    """The agent of a file; `DatasetError` for another number of parameters."""
    shown = (name for name in WORLDS if PICTURES in getattr(find_task(name), "agent_pictures", {}))
    manifest = AgentManifest(
        name="attention-agent", task=next(shown), preprocessing=PICTURES, choices=one_hot(3).choices, frame_skip=1,
        state=2 * UNITS, provenance={"imported": SOURCE, "versions": {"dreamfleet": package_version("dreamfleet")}},
    )  # fmt: skip
    return TrainedAgent(manifest, export_network(_read_weights(path)))


def _read_weights(path: Path) -> Weights:
    try:
        numbers = read_arrays(path, AGENT_LIMITS, (AGENT_ARRAY,))[AGENT_ARRAY]
        ends = np.cumsum([np.prod(shape) for shape in SHAPES.values()])
        if numbers.shape != (ends[-1],) or numbers.dtype.kind != "f":
            raise ValueError(f"{numbers.dtype} of shape {numbers.shape}, and an agent has {ends[-1]} floats")
    except (OSError, ValueError, KeyError) as error:
        raise DatasetError(f"{path} holds no weights of AttentionAgent: {error}") from error
    parts = np.split(check_range(path, numbers), ends[:-1])
    return {name: part.reshape(shape) for part, (name, shape) in zip(parts, SHAPES.items(), strict=True)}


def export_network(weights: Weights) -> bytes:
    """The network as ONNX: from `picture` and `state` (hidden, then cell) to the `worth` of stay, left and right.

    All patches vote, by the softmax of their queries on all keys. The places of the ten with most votes, most first,
    are what the LSTM sees.
    """
    graph, kind = _Graph("attention_agent"), TensorProto.FLOAT
    picture = graph.add_input("picture", TensorProto.UINT8, SIDE, SIDE, 3)
    hidden, cell = graph.split(graph.add_input("state", kind, 2 * UNITS), UNITS, UNITS)
    levels = graph.node("Div", graph.node("Cast", picture, to=kind), graph.numbers(255))
    levels = graph.node("Transpose", levels, perm=[0, 3, 1, 2])
    queries, keys = (
        graph.node("Reshape", _project(graph, levels, weights, name), graph.shape(-1, 4, PLACES**2))
        for name in ("query", "key")
    )
    products = graph.node("MatMul", graph.node("Transpose", queries, perm=[0, 2, 1]), keys)
    scaled = graph.node("Div", products, graph.numbers(np.sqrt(3 * PATCH**2)))
    votes = graph.node("ReduceSum", graph.node("Softmax", scaled, axis=-1), graph.shape(1), keepdims=0)
    seen = graph.node("Reshape", _places_of_most(graph, votes), graph.shape(-1, 2 * CHOSEN))
    hidden, cell = lstm(graph, [seen], hidden, cell, weights)
    output = graph.node("Tanh", graph.linear(hidden, weights["out.weight"].T, weights["out.bias"]))
    stay = graph.node("Add", graph.node("Mul", output, graph.numbers(0)), graph.numbers(BAR))
    graph.add_output(graph.join(stay, graph.node("Neg", output), output), "worth", kind, 3)
    graph.add_output(graph.join(hidden, cell), "next_state", kind, 2 * UNITS)
    return graph.build()


def _project(graph: GraphBuilder, levels: str, weights: Weights, name: str) -> str:
    """A linear layer on each patch of a picture, which is a convolution."""
    kernel = graph.constant(weights[f"{name}.weight"].transpose(0, 3, 1, 2))
    return graph.node("Conv", levels, kernel, graph.constant(weights[f"{name}.bias"]), strides=[STRIDE, STRIDE])


def _places_of_most(graph: _Graph, votes: str) -> str:
    """Row and column of the middles `(N, 10, 2)` of the patches with most votes, as parts of the picture's side."""
    middles = (PATCH // 2 + STRIDE * np.arange(PLACES, dtype=np.float32)) / np.float32(SIDE)
    rows, columns = np.meshgrid(middles, middles, indexing="ij")
    places = graph.constant(np.stack([rows.ravel(), columns.ravel()], axis=1))
    return graph.node("Gather", places, graph.most(votes, CHOSEN), axis=0)
