"""Encoder, MDN-RNN and one controller as one ONNX graph, made of a bundle's own graphs."""

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto

from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, ENCODER, Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.worldmodel.choice_memory import ChoiceMemory
from dreamfleet.worker.worldmodel.export import squash
from dreamfleet.worker.worldmodel.inference import PolicyStep, open_graph
from dreamfleet.worker.worldmodel.onnx_graph import GraphBuilder

Floats = NDArray[np.float32]
CHECKED_STEPS = 32


def export_driver(bundle: Bundle, controller: Controller) -> bytes:
    """Export one step of a controller on its world model: `picture` and `state` to `action` and `next_state`.

    `picture` is (N, side, side, 3) uint8, and `action` (N, actions) what the world takes. `state` (N, state) is zero as
    an episode begins. `UsageError` for a world model that sees rewards, which no picture shows.
    """
    own, kind = bundle.for_controller(controller), TensorProto.FLOAT
    if bundle.manifest.models.get("mdnrnn", {}).get("previous_reward"):
        raise UsageError(f"{bundle.path.name} also sees the last reward: pictures alone do not drive it")
    encoder, memory = (onnx.load_from_string(bundle.read(part)) for part in (ENCODER, DREAM_GRAPH))
    size = next(each for each in memory.graph.input if each.name == "state").type.tensor_type.shape.dim[1].dim_value
    columns = ChoiceMemory(own.driving).columns
    graph = GraphBuilder("driver")
    picture = graph.add_input("picture", TensorProto.UINT8, *bundle.manifest.picture)
    model, choices = graph.split(graph.add_input("state", kind, size + columns), size, columns)
    latent = graph.embed(encoder, {"picture": picture}, "mu")
    hidden, _ = graph.split(model, bundle.manifest.hidden, size - bundle.manifest.hidden)
    chooser = _Chooser(graph, own, choices)
    action = chooser.choose(controller.parameters, latent, hidden)
    after = graph.embed(memory, {"latent": latent, "action": action, "state": model}, "next_state")
    state = graph.join(after, chooser.next_choices(action))
    graph.add_output(action, "action", kind, own.driving.controls.actions)
    graph.add_output(state, "next_state", kind, size + columns)
    return graph.build()


def largest_difference(bundle: Bundle, controller: Controller, driver: bytes) -> float:
    """The largest difference of `export_driver`'s actions from those that `evaluate` applies, over a few random steps.

    0 if all are equal to the bit. Where a bundle has no graph of its controllers, NumPy computes them, and its last
    bits differ from ONNX Runtime's.
    """
    policy, graph = PolicyStep(bundle.for_controller(controller)), open_graph(driver, threads=1)
    random, parameters = np.random.default_rng(1), controller.parameters[None]
    own, state, worst = policy.zero_state(1), policy.zero_state(1), 0.0
    for _ in range(CHECKED_STEPS):
        picture = random.integers(0, 256, (1, *bundle.manifest.picture), np.uint8)
        wanted = policy.step(picture, parameters, own)
        action, state = graph.run(["action", "next_state"], {"picture": picture, "state": state})
        own, worst = wanted.state, max(worst, float(np.abs(action - wanted.action).max()))
    return worst


class _Chooser:
    """The controller and the memory of its choices, as `inference.Controllers` and `ChoiceMemory` compute them."""

    def __init__(self, graph: GraphBuilder, bundle: Bundle, choices: str) -> None:
        """`choices` are the state's columns of the last choice, the one before it, and how long it is held; or ""."""
        self._graph, self._driving, self._shape = graph, bundle.driving, bundle.controller_shape
        self._latent, self._actions = bundle.manifest.latent, bundle.driving.controls
        self._last = self._before = self._held = self._is_due = ""
        if choices:
            size = self._actions.actions
            self._last, self._before, self._held = graph.split(choices, size, size, 1)
            self._is_due = graph.node("Equal", self._held, graph.numbers(0))

    def choose(self, parameters: Floats, latent: str, hidden: str) -> str:
        """The action `(N, actions)`: a new one where it is due, else the held one."""
        graph, extra = self._graph, self._driving.extra_features
        parts = [latent, hidden] if self._shape.features - extra > self._latent else [latent]
        if extra:
            last, before = self._as_outputs(self._last), self._as_outputs(self._before)
            parts += [last, graph.node("Sub", last, before)]
        *inner, (weights, biases) = self._shape.unpack(parameters)
        value = graph.join(*parts)
        for each in inner:
            value = graph.node("Tanh", self._affine(value, *each))
        action = self._to_action(self._affine(value, weights, biases))
        return graph.node("Where", self._is_due, action, self._last) if self._is_due else action

    def next_choices(self, action: str) -> str:
        """The state's columns after a step with this action; "" if there are none."""
        if not self._is_due:
            return ""
        graph, every = self._graph, self._driving.decide_every
        before = graph.node("Where", self._is_due, self._last, self._before)
        held = graph.node("Mod", graph.node("Add", self._held, graph.numbers(1)), graph.numbers(every), fmod=1)
        return graph.join(action, before, held)

    def _affine(self, value: str, weights: Floats, biases: Floats) -> str:
        """As the bundle's graphs compute it, so that the bits are theirs: each row by a matrix product of its own."""
        graph = self._graph
        product = graph.node("MatMul", graph.constant(weights[None]), graph.node("Unsqueeze", value, graph.shape(2)))
        return graph.node("Add", graph.node("Squeeze", product, graph.shape(2)), graph.constant(biases[None]))

    def _to_action(self, logits: str) -> str:
        graph, actions = self._graph, self._actions
        if actions.choices:
            index = graph.node("ArgMax", logits, axis=1, keepdims=0)
            return graph.node("Gather", graph.numbers(actions.choices), index)
        if actions.groups:
            return self._choose_in_groups(logits)
        if not actions.squashed:
            return logits
        outputs = graph.node("Tanh", logits)
        if actions.output_indices:
            outputs = graph.node("Gather", outputs, graph.shape(*actions.output_indices), axis=1)
        return squash(graph, outputs, actions)

    def _choose_in_groups(self, logits: str) -> str:
        """`Continuous.to_action` with groups."""
        graph, layout, outputs = self._graph, self._actions.group_layout, self._actions.outputs
        groups, longest = layout.real.shape
        places = graph.node("Gather", logits, graph.shape(*layout.places.reshape(-1)), axis=1)
        table = graph.node("Reshape", places, graph.shape(-1, groups, longest))
        lowest = graph.numbers(-np.inf)
        found = graph.node("Where", graph.constant(layout.real[None]), table, lowest)
        chosen = graph.node("Add", graph.node("ArgMax", found, axis=2, keepdims=0), graph.shape(*layout.starts))
        depth, ends = graph.shape(outputs), graph.numbers([0, 1])
        one_hot = graph.node("ReduceSum", graph.node("OneHot", chosen, depth, ends), graph.shape(1), keepdims=0)
        return graph.node("Gather", one_hot, graph.shape(*layout.kept), axis=1)

    def _as_outputs(self, action: str) -> str:
        """`Continuous.to_outputs`."""
        graph, actions = self._graph, self._actions
        if actions.choices:
            table = graph.numbers([actions.choices])
            equal = graph.node("Equal", graph.node("Unsqueeze", action, graph.shape(1)), table)
            return graph.node("ReduceMin", graph.node("Cast", equal, to=TensorProto.FLOAT), axes=[2], keepdims=0)
        if actions.groups:
            other = graph.node("Sub", graph.numbers(1), action)
            return graph.node("Gather", graph.join(action, other), graph.shape(*actions.group_layout.order), axis=1)
        if actions.output_indices:
            outputs = actions.to_outputs(np.eye(actions.actions, dtype=np.float32))
            return graph.node("MatMul", action, graph.constant(outputs))
        return action
