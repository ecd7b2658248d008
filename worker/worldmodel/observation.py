"""The observations of agents trained outside dreamfleet, equal in the dream and in reality."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.errors import UsageError

Floats = NDArray[np.float32]
FEATURES = ("z", "zh")


class Observation:
    """`z`: the latent. `zh`: the latent and the MDN-RNN's hidden state, without which movement is invisible."""

    def __init__(self, bundle: Bundle, features: str) -> None:
        """`UsageError` for features other than `z` and `zh`."""
        if features not in FEATURES:
            raise UsageError(f"an agent's features are {' or '.join(FEATURES)}, not {features!r}")
        self._hidden = bundle.manifest.hidden if features == "zh" else 0
        self.size = bundle.shape_of(features).features

    @property
    def space(self) -> Any:
        """The observation space: unbounded numbers `(size,)`."""
        most = float(np.finfo(np.float32).max)
        return spaces.Box(-most, most, (self.size,), np.float32)

    def observe(self, latent: Floats, state: Floats) -> Floats:
        """Copy the observations `(N, size)` from `latent` `(N, latent)` and the model's `state` `(N, state)`."""
        return join_features(latent, state, self._hidden)


def join_features(latent: Floats, state: Floats, hidden: int) -> Floats:
    """The features [z, h] `(N, latent + hidden)`: latents, then the first `hidden` columns of the model's state."""
    return np.concatenate([latent, state[:, :hidden]], axis=1)


def open_bundle(bundle: Bundle | str) -> Bundle:
    """Return a bundle as it is, or find one by its name or file."""
    return find_bundle(bundle) if isinstance(bundle, str) else bundle
