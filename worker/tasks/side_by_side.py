"""Optional: a policy that acts for several episodes at once."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


class Policies(Protocol):
    """Several controllers that act side by side, one a row; an action has the bits that it has alone."""

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Start an episode for each row of `parameters` `(rows, size)`."""

    def act(self, observations: NDArray[Any]) -> NDArray[Any]:
        """An action for each of the observations `(rows, ...)`."""

    def reward(self, values: NDArray[np.float64]) -> None:
        """Called with the rewards `(rows,)` of the last actions, before the next `act`."""

    def keep(self, rows: Sequence[int]) -> None:
        """Go on with these rows alone: the other episodes are over."""


@runtime_checkable
class PolicySideBySide(Protocol):
    """A policy that can act for several episodes at once.

    If its task has a `batch_size` of more than 1, a slot drives up to that many episodes side by side, each in an
    environment of its own. The worker finds which number of them takes least time a step.
    """

    def side_by_side(self) -> Policies:
        """The same policy for several controllers."""
