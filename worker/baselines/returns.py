"""What a choice was worth as far as it was seen, and what of it is still to be foretold."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


class Returns(NamedTuple):
    """Of an episode of T decisions, each `(T,)`."""

    value: Floats  # discounted rewards of the next n decisions, as far as there are any
    discount: Floats  # what the best choice behind them is multiplied by; 0 where the episode had ended
    known: NDArray[np.bool_]  # false where the episode was cut before the n decisions were over


def n_step(reward: NDArray[Any], terminal: bool, gamma: float, n: int) -> Returns:
    """Sutton & Barto 2018, equation 7.1: R_t = r_t + gamma r_t+1 + ... + gamma^(n-1) r_t+n-1, then gamma^n Q(t + n).

    Behind a terminal there is nothing to foretell. Where an episode was only cut, by a limit of steps or by patience,
    the last n decisions have no successor that was seen, and nothing is learnt from them.
    """
    length = len(reward)
    padded = np.concatenate([np.asarray(reward, np.float64), np.zeros(n)])
    value = sum((gamma**ahead * padded[ahead : ahead + length] for ahead in range(n)), np.zeros(length))
    followed = np.arange(length) + n < length
    discount = np.where(followed, gamma**n, 0.0)
    return Returns(value.astype(np.float32), discount.astype(np.float32), followed | terminal)
