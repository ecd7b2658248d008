"""Random drivers, which collect the data of the first world model.

`DRIVERS` are three kinds of noise, so that the model sees straight, weaving and spinning cars. All of them prefer gas,
because a standing car teaches nothing. The other drivers reproduce those of published sources.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PUSH = (-0.1, 1.0, 0.0)
HELD_FRAMES = 20  # an action is steering in [-1, 1], gas and brake in [0, 1]


class HeldDriver:
    """Uniform steering and a uniform pedal, held for 20 frames."""

    def __init__(self, random: np.random.Generator) -> None:
        self._random = random
        self._left = 0
        self._action = np.zeros(3)

    def act(self) -> NDArray[np.float32]:
        """The held action, or a new one."""
        if self._left == 0:
            steer, pedal = self._random.uniform(-1, 1), self._random.uniform(-0.5, 1)
            self._action = _controls(steer, pedal)
            self._left = HELD_FRAMES
        self._left -= 1
        return self._action.astype(np.float32)


class UniformDriver:
    """A sample of the action space, held for 20 frames; gas and brake are independent (the notebook's data)."""

    def __init__(self, random: np.random.Generator) -> None:
        self._random = random
        self._steps = 0
        self._action = np.zeros(3, dtype=np.float32)

    def act(self) -> NDArray[np.float32]:
        """The held action, or a new one."""
        if self._steps % HELD_FRAMES == 0:
            self._action = self._choose()
        self._steps += 1
        return self._action

    def _choose(self) -> NDArray[np.float32]:
        return self._random.uniform((-1, 0, 0), 1).astype(np.float32)


class PushedDriver(UniformDriver):
    """A first push, then one control at a time, each held for 20 frames (the article's data).

    Of ten equally likely choices one does nothing, four give gas, two steer left, two steer right, and one brakes.
    """

    def _choose(self) -> NDArray[np.float32]:
        if self._steps == 0:
            return np.array(PUSH, dtype=np.float32)
        strength = self._random.random()
        controls = ((0, 0, 0), *[(0, 1, 0)] * 4, *[(-1, 0, 0)] * 2, *[(1, 0, 0)] * 2, (0, 0, 1))
        return np.array(controls[self._random.integers(len(controls))], dtype=np.float32) * np.float32(strength)


class OrnsteinUhlenbeckDriver:
    """Steering and pedal as Ornstein-Uhlenbeck processes, which return to straight ahead and slight gas."""

    def __init__(self, random: np.random.Generator) -> None:
        self._random = random
        self._centre = np.array([0.0, random.uniform(0.1, 0.5)])
        self._value = self._centre.copy()

    def act(self) -> NDArray[np.float32]:
        """One step of the process: return rate 0.05, noise 0.12 and 0.06."""
        noise = self._random.normal(size=2) * (0.12, 0.06)
        self._value += 0.05 * (self._centre - self._value) + noise
        return _controls(*self._value).astype(np.float32)


class RandomWalkDriver:
    """Steering and pedal as random walks between bounds (ctallec's Brownian data)."""

    def __init__(self, random: np.random.Generator) -> None:
        self._random = random
        self._value = np.array([random.uniform(-0.3, 0.3), random.uniform(0.0, 0.6)])

    def act(self) -> NDArray[np.float32]:
        """One step: noise 0.14 in steering, 0.07 in the pedal."""
        self._value += self._random.normal(size=2) * (0.14, 0.07)
        self._value = np.clip(self._value, (-1.0, -0.4), (1.0, 1.0))
        return _controls(*self._value).astype(np.float32)


DRIVERS: dict[str, type[HeldDriver] | type[OrnsteinUhlenbeckDriver] | type[RandomWalkDriver]] = {
    "held": HeldDriver,
    "ornstein-uhlenbeck": OrnsteinUhlenbeckDriver,
    "random-walk": RandomWalkDriver,
}


def _controls(steer: float, pedal: float) -> NDArray[np.float64]:
    """The action `(3,)` of a steering and one pedal: positive is gas, negative is brake."""
    return np.array([np.clip(steer, -1, 1), np.clip(pedal, 0, 1), np.clip(-pedal, 0, 1)])
