"""How a controller's outputs become a world's actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Continuous:
    """Outputs in [-1, 1], each scaled, shifted and bounded: `clip(scale * tanh(x) + shift, low, high)`."""

    scale: tuple[float, ...]
    shift: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def between(cls, low: Any, high: Any) -> Continuous:
        """The whole range from `low` to `high` `(actions,)`, its middle at an output of 0."""
        low, high = (np.asarray(each, dtype=np.float64).reshape(-1) for each in (low, high))
        return cls(*(tuple(map(float, each)) for each in ((high - low) / 2, (high + low) / 2, low, high)))

    @property
    def outputs(self) -> int:
        """Outputs of a controller."""
        return len(self.scale)

    def of(self, logits: Floats) -> Floats:
        """The action `(actions,)` of what a controller's last layer adds up to."""
        scale, shift, low, high = (np.array(each, np.float32) for each in (self.scale, self.shift, self.low, self.high))
        action: Floats = np.clip(np.tanh(logits) * scale + shift, low, high).astype(np.float32)
        return action


@dataclass(frozen=True)
class Discrete:
    """One of `outputs` actions: the one with the largest output, of equals the first."""

    outputs: int
    first: int = 0  # the environment's number of the first one

    def of(self, logits: Floats) -> np.int64:
        """The action's number."""
        return np.int64(self.first + int(np.argmax(logits)))


Actions = Continuous | Discrete

# hardmaru/WorldModelsExperiments, carracing: steering tanh; gas (tanh + 1) / 2; brake clip(tanh, 0, 1).
STEERING_GAS_BRAKE = Continuous(scale=(1, 0.5, 1), shift=(0, 0.5, 0), low=(-1, 0, 0), high=(1, 1, 1))
