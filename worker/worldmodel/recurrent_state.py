"""A world model's latent and recurrent state along a drive, under any driver."""

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.worker.worldmodel.inference import DreamStep, Encoder, RewardLabel

Floats = NDArray[np.float32]


class RecurrentState:
    """The latent `(1, latent)` of the last picture, and the recurrent state `(1, state)` before the next action."""

    def __init__(self, bundle: Bundle) -> None:
        self._encoder, self._memory, self._label = Encoder(bundle), DreamStep(bundle), RewardLabel(bundle)
        self.hidden = bundle.manifest.hidden
        self.begin()

    def begin(self) -> None:
        """Begin an episode with a zero state."""
        self.latent = np.zeros((1, self._memory.latent_size), dtype=np.float32)
        self.state = self._memory.zero_state(1)

    def see(self, picture: NDArray[np.uint8]) -> None:
        """Encode a picture `(side, side, 3)`."""
        self.latent, _ = self._encoder.encode(picture[None])

    def advance(self, action: Floats, chosen: Floats | None = None) -> None:
        """Advance by the applied action `(1, actions)`; `chosen` is the controller's if it differs."""
        self.state = self._memory.advance(self.latent, action, self.state, chosen)

    def reward(self, value: float) -> None:
        """Record the reward of the last action, which some models see in the next step."""
        self._label.write(self.state, np.array([value]))
