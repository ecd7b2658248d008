"""Run the frozen world model in ONNX Runtime: on one thread, and a row's bits do not depend on its batch."""

from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import (
    DECODER,
    DREAM_GRAPH,
    ENCODER,
    LAYERED_CONTROLLER,
    LINEAR_CONTROLLER,
    POLICY,
    Bundle,
)
from dreamfleet.common.artifacts.onnx_checks import check_self_contained
from dreamfleet.common.errors import BundleError
from dreamfleet.worker.worldmodel.choice_memory import ChoiceMemory, Layer, compute_actions

Floats = NDArray[np.float32]
Array = TypeVar("Array")  # of NumPy, or of torch
Pictures = NDArray[np.uint8]
ATTENTION = "attention"  # output of dream graphs with attention


def open_part(bundle: Bundle, name: str) -> onnxruntime.InferenceSession:
    """Open one of a bundle's graphs on one thread, because each core has its own scoring process."""
    graph = bundle.read(name)
    try:
        return open_untrusted_graph(graph)
    except Exception as error:  # the runtime's errors share no public base
        raise BundleError(f"{bundle.path}: {name} cannot be run ({error})") from error


def open_untrusted_graph(graph: bytes) -> onnxruntime.InferenceSession:
    """Open a graph from an untrusted file on one thread.

    `ValueError` if it names other files; the runtime's own errors, which share no base, if it cannot be run.
    """
    check_self_contained(graph)
    return open_graph(graph, threads=1)


def open_graph(graph: bytes, threads: int) -> onnxruntime.InferenceSession:
    """Open an ONNX graph on `threads` threads; a row's bits do not depend on their number."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1  # docs/explanation/decisions.md
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.load_model_format", "ONNX")  # not the format that its first bytes suggest
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])


def check_sizes(
    bundle: Bundle, name: str, session: onnxruntime.InferenceSession, expected: dict[str, list[int]]
) -> None:
    """`BundleError` if a graph's inputs or outputs do not have the `expected` sizes (without the batch)."""
    found = {each.name: each.shape[1:] for each in (*session.get_inputs(), *session.get_outputs())}
    for value, shape in expected.items():
        if found.get(value) != shape:
            raise BundleError(
                f"{bundle.path}: {value} of {name} has sizes {found.get(value)}, its manifest says {shape}; build the "
                "bundle again"
            )


class PolicyOutput(NamedTuple):
    """The outputs of a policy step, one row per episode: `action` (N, actions), `state` and `latent`.

    `state` is the next step's: h comes first, the controller's memory of its choices last.
    """

    action: Floats
    state: Floats
    latent: Floats


class PolicyStep:
    """Encoder, controller and MDN-RNN: a single graph for default controllers where there is one, else three."""

    def __init__(self, bundle: Bundle) -> None:
        self.shape = bundle.controller_shape
        self.hidden_size = bundle.manifest.hidden
        self._reward = RewardLabel(bundle)
        is_plain = bundle.driving.without_costs.is_default and self.shape == bundle.default_shape
        self._one_graph = is_plain and POLICY in bundle.manifest.parts
        if self._one_graph:
            session = open_part(bundle, POLICY)
            manifest = bundle.manifest
            expected = {"picture": [*manifest.picture], "parameters": [self.shape.size], "latent": [manifest.latent]}
            check_sizes(bundle, POLICY, session, expected)
            sizes = {each.name: each.shape for each in session.get_inputs()}
            if "state" not in sizes:
                raise BundleError(f"{bundle.path.name} was built by a version that is too old: build it again")
            self.state_size = int(sizes["state"][1])
            self._run = session.run
        else:
            self._encoder, self._controllers = Encoder(bundle), Controllers(bundle)
            self._memory = DreamStep(bundle)
            self.state_size = self._memory.state_size

    def step(self, picture: Pictures, parameters: Floats, state: Floats) -> PolicyOutput:
        """Act and advance on `picture` (N, side, side, 3), `parameters` (N, size) and `state` (N, state_size)."""
        if not self._one_graph:
            latent, _ = self._encoder.encode(picture)
            action = self._controllers.act(parameters, latent, state)
            return PolicyOutput(action, self._memory.advance(latent, action, state), latent)
        feed = {"picture": picture, "parameters": parameters, "state": state}
        return PolicyOutput(*self._run(["action", "next_state", "latent"], feed))

    def zero_state(self, rows: int) -> Floats:
        """The state before the first step."""
        return self._reward.begin(np.zeros((rows, self.state_size), dtype=np.float32))

    def write_rewards(self, state: Floats, rewards: NDArray[np.float64]) -> None:
        """Write the last step's rewards (N,) into `state`, if the model takes them as input."""
        self._reward.write(state, rewards)


class RewardLabel:
    """The previous reward in a state, in the form that the model takes as input; it does nothing for other models."""

    def __init__(self, bundle: Bundle) -> None:
        model = bundle.manifest.models.get("mdnrnn", {})
        self._column = 2 * bundle.manifest.hidden if model.get("previous_reward") else None
        self._kind = model.get("reward")
        self._first = float(model.get("first_reward", 0.0))
        self._scale = float(model.get("reward_scale", 1.0))

    def begin(self, state: Floats) -> Floats:
        """Set the previous reward of a first step, as in training, in a zero state; return the state."""
        if self._column is not None:
            state[:, self._column] = self._first
        return state

    def write(self, state: Floats, rewards: NDArray[np.float64]) -> None:
        """Write the reward head's label of `rewards` (N,) into `state`; no step may have ended its episode."""
        if self._column is None:
            return
        labels = rewards / self._scale if self._kind == "value" else (rewards > 0) == (self._kind == "positive")
        state[:, self._column] = labels


class Controllers:
    """Controllers of the bundle's shape, one per row, outside the policy's graph; in NumPy for variants."""

    def __init__(self, bundle: Bundle) -> None:
        self.shape, driving = bundle.controller_shape, bundle.driving
        self.choices = ChoiceMemory(driving)
        remembered = self.shape.features - driving.extra_features > bundle.manifest.latent
        self._hidden = bundle.manifest.hidden if remembered else 0
        self._actions = driving.controls
        graph = LAYERED_CONTROLLER if self.shape.hidden else LINEAR_CONTROLLER
        has_graph = driving.without_costs.is_default and graph in bundle.manifest.parts
        self._run = open_part(bundle, graph).run if has_graph else None
        self._parameters = np.zeros((0, self.shape.size), dtype=np.float32)
        self._layers: list[Layer] = []
        self._feed: dict[str, Floats] = {}

    def act(self, parameters: Floats, latent: Floats, state: Floats) -> Floats:
        """The actions (N, actions) of `parameters` (N, size), which are unpacked once: do not change them in place."""
        if parameters is not self._parameters:
            self._unpack(parameters)
        return self.choices.choose(state, lambda: self._decide(latent, state))

    def _unpack(self, parameters: Floats) -> None:
        self._layers = [(np.ascontiguousarray(a), np.ascontiguousarray(b)) for a, b in self.shape.unpack(parameters)]
        for index, (weights, biases) in enumerate(self._layers):
            self._feed |= {f"weights{index}": weights, f"biases{index}": biases}
        self._parameters = parameters

    def _decide(self, latent: Floats, state: Floats) -> Floats:
        parts = [latent, state[:, : self._hidden]] if self._hidden else [latent]
        parts += [self.choices.features(state)] if self.choices.extra_features else []
        features = np.concatenate(parts, axis=1) if len(parts) > 1 else latent
        if self._run is None:
            return compute_actions(self._layers, features, self._actions)
        (action,) = self._run(["action"], {**self._feed, "features": features})
        return np.asarray(action, dtype=np.float32)


class DreamOutput(NamedTuple, Generic[Array]):
    """The outputs of a dream step, one row per dream: `action`, `latent`, `state`, and the heads' outputs (N,).

    `reward` is the probability of the reward head's label, or the predicted value; `done` is a probability. Without
    such a head they are zero.
    """

    action: Array
    latent: Array
    state: Array
    reward: Array
    done: Array


class NoiseSize(NamedTuple):
    """The random numbers of one dream step: how many per row, and the dropout rate (0: none)."""

    latent: int
    hidden: int
    dropout: float


class DreamStep:
    """Controller and MDN-RNN, which samples the next latent."""

    def __init__(self, bundle: Bundle) -> None:
        session, manifest = open_part(bundle, DREAM_GRAPH), bundle.manifest
        check_sizes(bundle, DREAM_GRAPH, session, {"latent": [manifest.latent], "action": [manifest.actions]})
        sizes = {each.name: each.shape for each in session.get_inputs()}
        self._run = session.run
        outputs = [each.name for each in session.get_outputs()]
        self.has_attention = ATTENTION in outputs
        self._names = [name for name in outputs if name != ATTENTION]
        self._controllers = Controllers(bundle)
        self._choices, self._reward = self._controllers.choices, RewardLabel(bundle)
        self._run_options = onnxruntime.RunOptions()
        self._run_options.only_execute_path_to_fetches = True
        self.shape = bundle.controller_shape
        self.hidden_size = bundle.manifest.hidden
        self.memory_size: int = sizes["state"][1]  # columns of the state that are the world model's
        self.state_size = self.memory_size + self._choices.columns
        self.latent_size: int = sizes["latent"][1]
        dropout = float(manifest.models["mdnrnn"]["dropout"]) if "mask" in sizes else 0.0
        self.chance = NoiseSize(self.latent_size, self.hidden_size, dropout)

    def step(
        self, latent: Floats, parameters: Floats, state: Floats, uniform: Floats, normal: Floats,
        temperature: float, mask: Floats | None = None,
    ) -> DreamOutput[Floats]:  # fmt: skip
        """Act on `latent` (N, latent) and `state` (N, state_size) by `parameters` (N, size), and dream the next step.

        `uniform` in [0, 1) and `normal` (N, latent) are random numbers. `mask` (N, hidden) is the dropout of models
        trained with it: 0 or 1 / (1 - rate); without a mask nothing is dropped.
        """
        action = self._controllers.act(parameters, latent, state)
        return self.imagine(latent, action, state, uniform, normal, temperature, mask)

    def imagine(
        self, latent: Floats, action: Floats, state: Floats, uniform: Floats, normal: Floats,
        temperature: float, mask: Floats | None = None, chosen: Floats | None = None,
    ) -> DreamOutput[Floats]:  # fmt: skip
        """Dream the next step under actions `(N, actions)`; `chosen` are the controllers' own if others are applied."""
        feed = self._feed(latent, action, state, uniform, normal, temperature, mask)
        given = dict(zip(self._names, self._run(self._names, feed), strict=True))
        none = np.zeros(len(latent), dtype=np.float32)
        heads = given.get("reward", none), given.get("done", none)
        after = self._next_state(given["next_state"], state, action if chosen is None else chosen)
        return DreamOutput(action, given["next_latent"], after, *heads)

    def advance(self, latent: Floats, action: Floats, state: Floats, chosen: Floats | None = None) -> Floats:
        """The next state alone, for reality, where the next latent is seen; `chosen` as in `imagine`."""
        after = self._run_output("next_state", latent, action, state)
        return self._next_state(after, state, action if chosen is None else chosen)

    def attend(self, latent: Floats, action: Floats, state: Floats) -> Floats:
        """The attention weights (N, window) of the last inputs at this step, oldest first."""
        return self._run_output(ATTENTION, latent, action, state)

    def _run_output(self, output: str, latent: Floats, action: Floats, state: Floats) -> Floats:
        """Compute one output that does not depend on the random numbers."""
        zeros = np.zeros((len(latent), self.latent_size), dtype=np.float32)
        (found,) = self._run([output], self._feed(latent, action, state, zeros, zeros), self._run_options)
        return np.asarray(found, dtype=np.float32)

    def _feed(
        self, latent: Floats, action: Floats, state: Floats, uniform: Floats, normal: Floats,
        temperature: float = 1.0, mask: Floats | None = None,
    ) -> dict[str, Floats]:  # fmt: skip
        own = np.ascontiguousarray(state[:, : self.memory_size]) if self._choices.columns else state
        feed = {"latent": latent, "action": action, "state": own, "uniform": uniform, "normal": normal}
        feed["temperature"] = np.array([temperature], dtype=np.float32)
        if self.chance.dropout:
            feed["mask"] = np.ones((len(latent), self.hidden_size), np.float32) if mask is None else mask
        return feed

    def _next_state(self, models: Floats, state: Floats, chosen: Floats) -> Floats:
        """The world model's next state followed by the controllers' memory of their choices."""
        if not self._choices.columns:
            return models
        return np.concatenate([models, self._choices.next_columns(state, chosen)], axis=1)

    def zero_state(self, rows: int) -> Floats:
        """The state before the first step."""
        return self._reward.begin(np.zeros((rows, self.state_size), dtype=np.float32))


class Encoder:
    """The encoder, from pictures to latents."""

    def __init__(self, bundle: Bundle) -> None:
        session, manifest = open_part(bundle, ENCODER), bundle.manifest
        check_sizes(bundle, ENCODER, session, {"picture": list(manifest.picture), "mu": [manifest.latent]})
        self._run = session.run

    def encode(self, picture: Pictures) -> tuple[Floats, Floats]:
        """`mu` and `logvar` (N, latent) of `picture` (N, side, side, 3)."""
        mu, logvar = self._run(["mu", "logvar"], {"picture": picture})
        return mu, logvar


class Decoder:
    """The decoder, from latents to pictures."""

    def __init__(self, bundle: Bundle) -> None:
        self._run = open_part(bundle, DECODER).run

    def decode(self, latent: Floats) -> Pictures:
        """`picture` (N, side, side, 3) of `latent` (N, latent)."""
        (picture,) = self._run(["picture"], {"latent": latent})
        result: Any = picture
        return np.asarray(result, dtype=np.uint8)
