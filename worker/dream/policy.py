"""A controller inside a dream environment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.worker.worldmodel.inference import Controllers, DreamStep

Floats = NDArray[np.float32]


class DreamPolicy:
    """Observes the latent, and remembers as the dream does."""

    def __init__(self, bundle: Bundle) -> None:
        self._controllers, self._step = Controllers(bundle), DreamStep(bundle)
        self._state = self._step.zero_state(1)
        self._parameters = np.zeros((1, self._step.shape.size), dtype=np.float32)

    def begin(self, parameters: Floats) -> None:
        """Begin an episode with this controller's flat vector."""
        self._step.shape.check(parameters)
        self._parameters = parameters.astype(np.float32).reshape(1, -1)
        self._state = self._step.zero_state(1)

    def set_memory(self, memory: Floats) -> None:
        """Begin with what the model remembers `(memory,)`, as the dream does: `reset` of its environment tells it."""
        self._state[:, : self._step.memory_size] = memory

    def act(self, observation: Floats) -> Floats:
        """The action `(actions,)` for one latent."""
        latent = observation[None]
        action = self._controllers.act(self._parameters, latent, self._state)
        self._state = self._step.advance(latent, action, self._state)
        chosen: Floats = action[0]
        return chosen
