"""Export a trained network as an agent that drives without torch."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
from onnx import TensorProto

from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.host.processes import shell_command
from dreamfleet.worker.addons.baselines.network import Networks
from dreamfleet.worker.addons.baselines.presets import CHECKPOINT, DRQN, AgentConfig
from dreamfleet.worker.addons.baselines.progress import parse_progress
from dreamfleet.worker.training.checkpoint import load_checkpoint, load_config
from dreamfleet.worker.training.data.dataset import preprocessing_of_size
from dreamfleet.worker.worldmodel.mdnrnn_graph import Weights, lstm
from dreamfleet.worker.worldmodel.onnx_graph import GraphBuilder
from dreamfleet.worker.worlds.trained_agent import AgentManifest, TrainedAgent


def export_agent(folder: Path) -> TrainedAgent:
    """Return the agent of a training's last checkpoint; `UsageError` if there is none, `DatasetError` if damaged."""
    path = folder / CHECKPOINT
    if not path.exists():
        raise UsageError(
            f"no agent at {path}: train one with `{shell_command('baseline', 'train', DRQN, '--data', folder)}`"
        )
    config = load_config(path, AgentConfig)
    networks = Networks(config)
    progress = parse_progress(path, load_checkpoint(path, networks, None))
    weights = {name: tensor.numpy() for name, tensor in networks.online.state_dict().items()}
    if not all(np.isfinite(each).all() for each in weights.values()):
        raise DatasetError(f"{path} holds NaN or infinity: give --new to start over with a lower --rate")
    driven = progress.episodes
    provenance = {
        "episodes": len(driven), "steps": sum(each.steps for each in driven),
        "decisions": sum(each.decisions for each in driven), "updates": progress.update,
        "layers": asdict(config), "learning": progress.learning,
        "versions": {package: package_version(package) for package in ("dreamfleet", "gymnasium", "torch")},
    }  # fmt: skip
    choices = tuple(tuple(map(float, each)) for each in config.table)
    pictures = preprocessing_of_size(config.picture).name
    manifest = AgentManifest(DRQN, FIRST_WORLD, pictures, choices, config.frame_skip, 2 * config.hidden, provenance)
    return TrainedAgent(manifest, export_network(weights, config))


def export_network(weights: Weights, config: AgentConfig) -> bytes:
    """Return the ONNX graph of one decision.

    Inputs: `picture` (N, side, side, 3) uint8 and `state` (N, 2 * hidden), the LSTM's hidden and cell state, zero as an
    episode begins. Outputs: `worth` (N, choices), the Q values, and `next_state` (N, 2 * hidden).
    """
    graph, choices = GraphBuilder("agent"), len(config.table)
    picture = graph.add_input("picture", TensorProto.UINT8, config.picture, config.picture, 3)
    hidden, cell = graph.split(
        graph.add_input("state", TensorProto.FLOAT, 2 * config.hidden), config.hidden, config.hidden
    )
    value = graph.node("Cast", graph.node("Transpose", picture, perm=[0, 3, 1, 2]), to=TensorProto.FLOAT)
    value = graph.node("Div", value, graph.numbers(255))
    for layer, stride in enumerate(config.strides):
        kernel, bias = (graph.constant(weights[f"look.{2 * layer}.{each}"]) for each in ("weight", "bias"))
        value = graph.node("Relu", graph.node("Conv", value, kernel, bias, strides=[stride, stride]))
    flat = graph.node("Reshape", value, graph.shape(-1, config.flat))
    hidden, cell = lstm(graph, [flat], hidden, cell, weights)
    worth, advantage = (
        graph.linear(hidden, weights[f"{each}.weight"].T, weights[f"{each}.bias"]) for each in ("value", "advantage")
    )
    if config.heads == "softmax":
        advantage = graph.node("Softmax", advantage, axis=1)
    advantage = graph.node("Sub", advantage, graph.node("ReduceMean", advantage, axes=[1]))
    graph.add_output(graph.node("Add", worth, advantage), "worth", TensorProto.FLOAT, choices)
    graph.add_output(graph.join(hidden, cell), "next_state", TensorProto.FLOAT, 2 * config.hidden)
    return graph.build()
