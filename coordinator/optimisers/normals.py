"""Standard normal samples from a generator whose state can be written down, drawn ahead where there is time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Normals:
    """A source of samples as pycma takes one, in the option `randn`."""

    def __init__(self, seed: int) -> None:
        self._generator = np.random.Generator(np.random.PCG64(seed))
        self._ahead: tuple[dict[str, Any], NDArray[np.float64]] | None = None  # the state before it, and what was drawn

    def __call__(self, *shape: int) -> NDArray[np.float64]:
        """Draw an array of `shape`, as pycma asks for it."""
        if self._ahead is not None and self._ahead[1].shape == shape:
            _, drawn = self._ahead
            self._ahead = None
            return drawn
        self.state = self.state
        return self._generator.standard_normal(shape)

    def draw_ahead(self, *shape: int) -> None:
        """Draw now what is likely asked for next; no number changes by it."""
        if self._ahead is None:
            self._ahead = self.state, self._generator.standard_normal(shape)

    @property
    def state(self) -> dict[str, Any]:
        """The generator's state, as if nothing was drawn ahead."""
        return self._ahead[0] if self._ahead is not None else dict(self._generator.bit_generator.state)

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        self._ahead = None
        self._generator.bit_generator.state = state
