"""The MDN-RNN: an LSTM that predicts the next latents as mixtures of Gaussians, and optionally reward and end.

A mixture for each latent dimension as in hardmaru/WorldModelsExperiments. Heads from its successors: the reward in
three forms, and whether the episode ends (the paper's Doom). The additive attention over past inputs is the intended
one of miketynes/AttentiveWorldModels; its code takes the softmax over the batch on a state that stays zero.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from dreamfleet.worker.worldmodel.columns import in_columns, in_no_column, join, share_weights
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig, Reward

COLUMN_REACH = 2  # columns that a unit of the LSTM sees on each side of its own
HEAD_CHANNELS = 64


class Prediction(NamedTuple):
    """The mixtures of the next latents: log weights, means and log deviations `(..., latent, mixtures)`.

    The log weights of a joint mixture are `(..., 1, mixtures)`, with columns `(..., side, mixtures)`.
    `reward` (logit or value) and `done` (logit) are `(...)`, and zero without such a head.
    """

    log_weights: Tensor
    means: Tensor
    log_deviations: Tensor
    reward: Tensor
    done: Tensor


class MDNRNN(nn.Module):  # mdnrnn_graph.py writes the same step as ONNX
    """From latents, actions and previous reward `(N, T, inputs)` to a prediction for each step.

    Attention (Bahdanau et al. 2015, arXiv:1409.0473): score_i = v tanh(W1 x_i + W2 h) over the last `window` inputs
    x = (z, a), the current one included, zeros before the first; softmax over these steps. The weighted sum of inputs
    enters the LSTM beside the current input, so the plain model is the special case of zero weights on it.
    """

    def __init__(self, config: MDNRNNConfig) -> None:
        super().__init__()
        self.config = config
        self.lstm = nn.LSTM(config.lstm_inputs, config.hidden, batch_first=True)
        with torch.no_grad():  # one bias as in the sources, though torch adds two
            self._second_bias.zero_()
        self._second_bias.requires_grad_(False)
        self.heads = ColumnHeads(config) if config.columns else nn.Linear(config.hidden, config.outputs)
        if config.columns and not self._second_bias.is_meta:  # of which only the shapes are asked
            self._share_weights()
        if config.window:  # docs/explanation/sources.md, docs/explanation/decisions.md
            self.keys = nn.Linear(config.latent + config.actions, config.attention_units)
            self.query = nn.Linear(config.hidden, config.attention_units, bias=False)
            self.score = nn.Linear(config.attention_units, 1, bias=False)

    def _share_weights(self) -> None:
        config = self.config
        side, units = config.side, config.units_in_columns
        hidden = join(in_columns(units, side), in_no_column(config.hidden - units))
        inputs = join(in_columns(config.latent, side), in_no_column(config.inputs - config.latent))
        for name, seen in (("weight_ih_l0", inputs), ("weight_hh_l0", hidden)):
            share_weights(self.lstm, name, join(*[hidden] * 4), seen, COLUMN_REACH)

    @property
    def _second_bias(self) -> Tensor:
        return self.lstm.get_parameter("bias_hh_l0")

    def forward(self, inputs: Tensor) -> Prediction:
        """Predict each step of sequences that begin with a zero state."""
        hidden: Tensor = self._run_with_attention(inputs) if self.config.window else self.lstm(inputs)[0]
        return self.predict(self._features(inputs, hidden))

    def predict(self, features: Tensor) -> Prediction:
        """Apply the heads to what `advance` returns, `(..., hidden)` or in columns `(..., inputs + hidden)`."""
        config = self.config
        out = self.heads(functional.dropout(features, config.dropout, self.training))
        ends = config.mixtures * sum(config.rows)
        parts = out[..., :ends].split([config.mixtures * count for count in config.rows], dim=-1)
        shapes = [(*out.shape[:-1], count, config.mixtures) for count in config.rows]
        weights, means, deviations = (part.reshape(shape) for part, shape in zip(parts, shapes, strict=True))
        none = out.new_zeros(out.shape[:-1])
        reward = out[..., ends] if config.has_reward_head else none
        done = out[..., -1] if config.done else none
        return Prediction(functional.log_softmax(weights, dim=-1), means, deviations, reward, done)

    def advance(self, steps: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Step on latents and actions `(N, latent + actions)` from a state `(N, state)`.

        Return what the heads see, the LSTM's output and in columns the inputs before it, and the next state.
        The previous reward comes from the state; the next state keeps it until the caller writes the new one.
        """
        config = self.config
        sizes = [config.hidden, config.hidden, int(config.previous_reward), config.window * steps.shape[1]]
        hidden, cell, previous, window = torch.split(state, sizes, dim=1)
        inputs = [steps, previous]
        if config.window:
            window = torch.cat([window[:, steps.shape[1] :], steps], dim=1)
            seen = window.reshape(-1, config.window, steps.shape[1])
            inputs.append(self._attend(seen, self.keys(seen), hidden))
        seen = torch.cat(inputs, dim=1)
        hidden, cell = self._cell(seen, hidden, cell)
        return self._features(seen, hidden), torch.cat([hidden, cell, previous, window], dim=1)

    def _features(self, inputs: Tensor, hidden: Tensor) -> Tensor:
        return torch.cat([inputs, hidden], dim=-1) if self.config.columns else hidden

    def _run_with_attention(self, inputs: Tensor) -> Tensor:
        config = self.config
        steps = functional.pad(inputs[..., : config.latent + config.actions], (0, 0, config.window - 1, 0))
        keys = self.keys(steps)
        hidden = cell = inputs.new_zeros(len(inputs), config.hidden)
        outputs = []
        for step in range(inputs.shape[1]):
            seen = slice(step, step + config.window)
            context = self._attend(steps[:, seen], keys[:, seen], hidden)
            hidden, cell = self._cell(torch.cat([inputs[:, step], context], dim=1), hidden, cell)
            outputs.append(hidden)
        return torch.stack(outputs, dim=1)

    def _attend(self, seen: Tensor, keys: Tensor, hidden: Tensor) -> Tensor:
        """The attention-weighted sum over the steps of the inputs `seen` `(N, window, latent + actions)`."""
        scores = self.score(torch.tanh(keys + self.query(hidden)[:, None]))
        weighted: Tensor = (torch.softmax(scores, dim=1) * seen).sum(dim=1)
        return weighted

    def _cell(self, inputs: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        weight: dict[str, Tensor] = dict(self.lstm.named_parameters())
        gates = functional.linear(inputs, weight["weight_ih_l0"], weight["bias_ih_l0"])
        gates = gates + functional.linear(hidden, weight["weight_hh_l0"], weight["bias_hh_l0"])
        enter, forget, candidate, leave = gates.chunk(4, dim=1)
        cell = torch.sigmoid(forget) * cell + torch.sigmoid(enter) * torch.tanh(candidate)
        return torch.sigmoid(leave) * torch.tanh(cell), cell


class ColumnHeads(nn.Module):
    """Convolutions over the columns, which see latents, action and the LSTM's output."""

    def __init__(self, config: MDNRNNConfig) -> None:
        super().__init__()
        self._config = config
        everywhere = config.inputs - config.latent + config.hidden - config.units_in_columns
        self.near = nn.Conv1d(config.columns + config.column_units, HEAD_CHANNELS, 5, padding=2)
        self.everywhere = nn.Linear(everywhere, HEAD_CHANNELS * config.side)  # things move apart as they come near
        self.second = nn.Conv1d(HEAD_CHANNELS, HEAD_CHANNELS, 3, padding=1)
        self.mixtures = nn.Conv1d(HEAD_CHANNELS, sum(config.rows) * config.mixtures // config.side, 1)
        if config.has_reward_head or config.done:
            self.others = nn.Linear(HEAD_CHANNELS * config.side, config.has_reward_head + config.done)

    def forward(self, features: Tensor) -> Tensor:
        """Outputs `(..., outputs)` as those of linear heads."""
        config, side = self._config, self._config.side
        ends = [config.latent, config.inputs, config.inputs + config.units_in_columns]
        latents, seen, units, rest = features.reshape(-1, features.shape[-1]).tensor_split(ends, dim=1)
        near = [latents.reshape(-1, config.columns, side), units.reshape(-1, config.column_units, side)]
        everywhere = self.everywhere(torch.cat([seen, rest], dim=1))
        value = torch.relu(self.near(torch.cat(near, dim=1)) + everywhere.reshape(-1, HEAD_CHANNELS, side))
        value = torch.relu(self.second(value))
        parts = self.mixtures(value).flatten(1).split([config.mixtures * count for count in config.rows], dim=1)
        out = [each.reshape(len(each), config.mixtures, -1).transpose(1, 2).flatten(1) for each in parts]
        if config.has_reward_head or config.done:
            out.append(self.others(value.flatten(1)))
        return torch.cat(out, dim=1).reshape(*features.shape[:-1], -1)


def latent_loss(prediction: Prediction, targets: Tensor, mask: Tensor) -> Tensor:
    """Negative log likelihood in nats per latent dimension of `targets` `(N, T, latent)` where `mask` `(N, T)` is 1."""
    scaled = (targets[..., None] - prediction.means) * torch.exp(-prediction.log_deviations)
    log_normal = -0.5 * scaled.square() - prediction.log_deviations - 0.5 * math.log(2 * math.pi)
    *shape, latents, mixtures = log_normal.shape
    weighted = prediction.log_weights.shape[-2]
    together = log_normal.reshape(*shape, latents // weighted, weighted, mixtures).sum(dim=-3)
    likelihood = torch.logsumexp(prediction.log_weights + together, dim=-1).sum(dim=-1) / latents
    return -(likelihood * mask).sum() / mask.sum().clamp(min=1)


def reward_labels(kind: Reward, rewards: Tensor, done: Tensor, scale: float = 1.0) -> Tensor:
    """The reward head's targets `(N, T)`; `done` is 1 where a step ended its episode. A value is divided by `scale`."""
    if kind == "value":
        return rewards if scale == 1 else rewards / scale
    positive = (rewards > 0).float()
    return positive if kind == "positive" else (1 - positive) * (1 - done)


def reward_loss(kind: Reward, predicted: Tensor, labels: Tensor, mask: Tensor) -> Tensor:
    """Mean squared error of a value, else binary cross-entropy in nats."""
    if kind == "value":
        return ((predicted - labels).square() * mask).sum() / mask.sum().clamp(min=1)
    return binary_loss(predicted, labels, mask)


def binary_loss(logits: Tensor, labels: Tensor, mask: Tensor, weight: float = 1.0) -> Tensor:
    """Binary cross-entropy in nats per step; steps with label 1 count `weight` times."""
    positive = None if weight == 1 else logits.new_tensor(weight)
    losses = functional.binary_cross_entropy_with_logits(logits, labels, reduction="none", pos_weight=positive)
    return (losses * mask).sum() / mask.sum().clamp(min=1)
