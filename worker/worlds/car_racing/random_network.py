"""A random network as a driver, as Ha & Schmidhuber 2018 collected their data (WorldModelsExperiments, extract.py)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE

Floats = NDArray[np.float32]
CHANNELS = (32, 64, 128, 256)  # of convolutions of kernel 4 and stride 2
LATENT, HIDDEN = 32, 256
MAX_SPREAD = 0.01  # of the weights of a drive's network
MAX_LOGVAR, MAX_LATENT = 20.0, 1e6  # bounds against infinities from the Cauchy distribution's tails


class RandomNetworkPolicy:
    """Encoder, LSTM and linear controller with Cauchy-distributed weights, whose scale is drawn for each drive."""

    def __init__(self, random: np.random.Generator) -> None:
        self._random = random
        self._spread = random.random() * MAX_SPREAD
        before = (3, *CHANNELS[:-1])
        self._kernels = [self._weights(16 * seen, made) for seen, made in zip(before, CHANNELS, strict=True)]
        self._gates = self._weights(LATENT + 3 + HIDDEN, 4 * HIDDEN)
        self._controller = self._weights(LATENT + HIDDEN, 3)
        self._heads: tuple[Floats, Floats] | None = None
        self._hidden = self._cell = np.zeros(HIDDEN, dtype=np.float32)

    def begin(self, parameters: Floats) -> None:
        """Ignore the parameters: its weights are random."""

    def act(self, observation: Any) -> Any:
        """Steering, gas and brake `(3,)` for one picture `(side, side, 3)`."""
        with np.errstate(over="ignore", invalid="ignore"):
            latent = self._encode(observation)
            action = STEERING_GAS_BRAKE.to_action(_layer(np.concatenate([latent, self._hidden]), self._controller))
            self._advance(np.concatenate([latent, action, self._hidden]))
        return action

    def _weights(self, inputs: int, outputs: int) -> Floats:
        """A layer's weights and, as the last row, its biases."""
        return (self._random.standard_cauchy((inputs + 1, outputs)) * self._spread).astype(np.float32)

    def _encode(self, picture: NDArray[np.uint8]) -> Floats:
        """Sample a latent `(32,)` from the encoder's distribution for the picture."""
        value: Floats = picture.astype(np.float32) / np.float32(255)
        for kernel in self._kernels:
            value = np.maximum(_convolve(value, kernel), np.float32(0))
        flat: Floats = value.reshape(-1)
        if self._heads is None:
            self._heads = self._weights(len(flat), LATENT), self._weights(len(flat), LATENT)
        mu, logvar = (_layer(flat, head) for head in self._heads)
        spread = np.exp(0.5 * np.minimum(logvar, MAX_LOGVAR))
        drawn = mu + spread * self._random.normal(size=LATENT)
        return np.clip(np.nan_to_num(drawn), -MAX_LATENT, MAX_LATENT).astype(np.float32)

    def _advance(self, inputs: Floats) -> None:
        enter, candidate, forget, leave = np.split(_layer(inputs, self._gates), 4)
        self._cell = _sigmoid(forget + 1) * self._cell + _sigmoid(enter) * np.tanh(candidate)
        self._hidden = _sigmoid(leave) * np.tanh(self._cell)


def _convolve(value: Floats, kernel: Floats) -> Floats:
    """Convolve `(side, side, channels)` with 4x4 kernels at stride 2."""
    seen = sliding_window_view(value, (4, 4), axis=(0, 1))[::2, ::2]
    return _layer(seen.reshape(*seen.shape[:2], -1), kernel)


def _layer(inputs: Floats, weights: Floats) -> Floats:
    outputs: Floats = inputs @ weights[:-1] + weights[-1]
    return outputs


def _sigmoid(value: Floats) -> Floats:
    result: Floats = np.float32(0.5) * (np.tanh(np.float32(0.5) * value) + np.float32(1))
    return result
