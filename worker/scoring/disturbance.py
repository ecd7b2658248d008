"""Noise on a drive's actions, so that it comes to where a calm one does not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous

Floats = NDArray[np.float32]
CORRELATION = 0.9  # from step to step: at 50 steps a second it turns within a fifth of one


class Disturbance:
    """Noise on actions that comes and goes: an autoregressive process, a pure function of the seed."""

    def __init__(self, seed: int, actions: Continuous, noise: float) -> None:
        self._random = np.random.default_rng(seed)
        self._actions = actions
        self._scale = noise * (np.array(actions.high) - np.array(actions.low)) / 2
        self._value = np.zeros(actions.actions)

    def next(self) -> Floats:
        """What is added to the next action `(1, actions)`."""
        fresh = self._random.standard_normal(len(self._value))
        self._value = CORRELATION * self._value + (1 - CORRELATION**2) ** 0.5 * fresh
        push: Floats = (self._value * self._scale).astype(np.float32)[None]
        return push

    def apply(self, chosen: Floats, push: Floats) -> Floats:
        """The actions that are done."""
        return add_disturbance(self._actions, chosen, push)


def add_disturbance(actions: Continuous, chosen: Floats, push: Floats) -> Floats:
    """Chosen actions `(rows, actions)` with a push on top, within their bounds.

    What rests at a bound stays there: a brake that nobody touches would else slow every drive.
    """
    low, high = np.array(actions.low, np.float32), np.array(actions.high, np.float32)
    resting = (chosen <= low) | (chosen >= high)
    done: Floats = np.where(resting, chosen, np.clip(chosen + push, low, high))
    return done
