"""A dreamed step of controllers and MDN-RNN in torch, for a graphics processor; the weights are the bundle's."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, EIGHT_BITS, SINGLE_PRECISION, Bundle
from dreamfleet.common.artifacts.bundle_store import describe_bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.schema.validation import from_plain
from dreamfleet.worker.addons.bundles.weights_from_graphs import mdnrnn_weights
from dreamfleet.worker.worldmodel.choice_memory import ChoiceMemory
from dreamfleet.worker.worldmodel.inference import DreamOutput
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, Prediction
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig


class StepNoise(NamedTuple):
    """The random numbers of a step, as `inference.DreamStep.step` takes them; `mask` is of models with dropout."""

    uniform: Tensor
    normal: Tensor
    mask: Tensor | None


class TorchDreamStep:
    """The same step as `inference.DreamStep`, on a torch device; its last bits differ."""

    def __init__(self, bundle: Bundle, device: torch.device, temperature: float) -> None:
        """`UsageError` for a world model of eight bits: torch dreams in single precision."""
        models = bundle.manifest.models
        if EIGHT_BITS in models:
            own, whole = bundle.sha256, str(bundle.manifest.provenance.get(SINGLE_PRECISION, ""))
            raise UsageError(
                f"torch_device: {describe_bundle(own)} has eight bits, and torch dreams in single precision: begin the "
                f"run with {describe_bundle(whole)}, or this worker without torch_device"
            )
        self._config = from_plain(MDNRNNConfig, models.get("mdnrnn"))
        self._model = MDNRNN(self._config)
        weights = mdnrnn_weights(bundle.read(DREAM_GRAPH), self._config)
        self._model.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in weights.items()})
        self._model.eval().to(device)
        self._controllers = _Controllers(bundle, device)
        self._device, self._temperature = device, temperature

    def set_parameters(self, parameters: NDArray[np.float32]) -> None:
        """Let each row act by its controller of `parameters` `(N, size)`; later calls overwrite the first one's."""
        self._controllers.set_parameters(parameters)

    def step(self, latent: Tensor, state: Tensor, noise: StepNoise) -> DreamOutput[Tensor]:
        """Act on `latent` (N, latent) and `state` (N, state), and dream the next step."""
        config = self._config
        action = self._controllers.act(latent, state)
        own, choices = torch.split(state, [config.state, state.shape[1] - config.state], dim=1)
        hidden, after = self._model.advance(torch.cat([latent, action], dim=1), own)
        predicted = self._model.predict(hidden if noise.mask is None else hidden * noise.mask)
        reward = predicted.reward if config.reward == "value" else torch.sigmoid(predicted.reward)
        if config.previous_reward:
            label = predicted.reward if config.reward == "value" else (predicted.reward > 0).float()
            after[:, 2 * config.hidden] = label
        if choices.shape[1]:
            after = torch.cat([after, self._controllers.next_choices(choices, action)], dim=1)
        following = self._sample(predicted, noise)
        none = torch.zeros_like(reward)
        done = torch.sigmoid(predicted.done) if config.done else none
        return DreamOutput(action, following, after, reward if config.has_reward_head else none, done)

    def _sample(self, predicted: Prediction, noise: StepNoise) -> Tensor:
        """The next latent (N, latent), sampled as `mdnrnn_graph.export_dream` describes."""
        logits, means, deviations, *_ = predicted
        uniform = noise.uniform[:, : self._config.weighted]
        weights = torch.exp((logits - logits.amax(dim=-1, keepdim=True)) / self._temperature)
        cumulated = weights.cumsum(dim=-1)
        point = uniform[..., None] * cumulated[..., -1:]
        chosen = (point >= cumulated[..., :-1]).sum(dim=-1, keepdim=True)
        chosen = chosen.repeat(1, self._config.latent // self._config.weighted, 1)
        mean, deviation = means.gather(-1, chosen)[..., 0], deviations.gather(-1, chosen)[..., 0]
        sampled: Tensor = mean + torch.exp(deviation) * (noise.normal * self._temperature**0.5)
        return sampled


class _Controllers:
    """Controllers of the bundle's shape, one per row, as `inference.Controllers` and `ChoiceMemory` compute them."""

    def __init__(self, bundle: Bundle, device: torch.device) -> None:
        self._shape, driving, self._device = bundle.controller_shape, bundle.driving, device
        remembered = self._shape.features - driving.extra_features > bundle.manifest.latent
        self._hidden = bundle.manifest.hidden if remembered else 0
        self._actions, self._every = driving.controls, driving.decide_every
        self._sees_choices = driving.extra_features > 0
        self._columns = ChoiceMemory(driving).columns
        self._layers: list[tuple[Tensor, Tensor]] = []
        scales = (self._actions.scale, self._actions.shift, self._actions.low, self._actions.high)
        self._scale, self._shift, self._low, self._high = (torch.tensor(each, device=device) for each in scales)
        self._choices = torch.tensor(self._actions.choices, device=device)
        self._columns_of_outputs = torch.tensor(self._actions.output_indices, dtype=torch.int64, device=device)
        layout = self._actions.group_layout
        self._starts, self._places, self._kept, self._order, self._real = (
            torch.from_numpy(each).to(device)
            for each in (layout.starts, layout.places, layout.kept, layout.order, layout.real)
        )
        if self._actions.output_indices:
            each_action = np.eye(self._actions.actions, dtype=np.float32)
            self._signs = torch.from_numpy(self._actions.to_outputs(each_action)).to(device)

    def set_parameters(self, parameters: NDArray[np.float32]) -> None:
        """Copy the layers of `parameters` `(N, size)` to the device: a captured graph reads the first call's memory."""
        layers = [tuple(torch.from_numpy(np.ascontiguousarray(each)) for each in pair)
                  for pair in self._shape.unpack(parameters)]  # fmt: skip
        if not self._layers:
            self._layers = [(weights.to(self._device), biases.to(self._device)) for weights, biases in layers]
        for own, given in zip(self._layers, layers, strict=True):
            for mine, each in zip(own, given, strict=True):
                mine.copy_(each)

    def act(self, latent: Tensor, state: Tensor) -> Tensor:
        """The actions (N, actions): a new choice where it is due, else the held one."""
        if not self._columns:
            return self._decide(torch.cat([latent, state[:, : self._hidden]], dim=1))
        last, before, held = self._split(state[:, -self._columns :])
        parts = [latent, state[:, : self._hidden]]
        if self._sees_choices:
            now, earlier = self._as_outputs(last), self._as_outputs(before)
            parts += [now, now - earlier]
        return torch.where(held == 0, self._decide(torch.cat(parts, dim=1)), last)

    def next_choices(self, choices: Tensor, chosen: Tensor) -> Tensor:
        """The columns (N, columns) after a step with the choice `chosen` (N, actions)."""
        last, before, held = self._split(choices)
        return torch.cat([chosen, torch.where(held == 0, last, before), (held + 1) % self._every], dim=1)

    def _split(self, choices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        size = self._actions.actions
        last, before, held = torch.split(choices, [size, size, 1], dim=1)
        return last, before, held

    def _decide(self, value: Tensor) -> Tensor:
        for index, (weights, biases) in enumerate(self._layers):
            value = torch.bmm(weights, value[:, :, None])[:, :, 0] + biases
            if index < len(self._layers) - 1:
                value = torch.tanh(value)
        actions = self._actions
        if actions.choices:
            return self._choices[value.argmax(dim=1)]
        if actions.groups:
            return self._choose_in_groups(value)
        if not actions.squashed:
            return value
        outputs = torch.tanh(value)
        if actions.output_indices:
            outputs = outputs[:, self._columns_of_outputs]
        return torch.clamp(outputs * self._scale + self._shift, self._low, self._high)

    def _as_outputs(self, action: Tensor) -> Tensor:
        """`Continuous.to_outputs`."""
        if self._actions.choices:
            return (action[:, None] == self._choices).all(dim=2).float()
        if self._actions.groups:
            return torch.cat([action, 1 - action], dim=1)[:, self._order]
        return action @ self._signs if self._actions.output_indices else action

    def _choose_in_groups(self, value: Tensor) -> Tensor:
        """`Continuous.to_action` with groups."""
        table = value[:, self._places].masked_fill(~self._real, -torch.inf)
        chosen = table.argmax(dim=2) + self._starts
        return torch.zeros_like(value).scatter_(1, chosen, 1.0)[:, self._kept]
