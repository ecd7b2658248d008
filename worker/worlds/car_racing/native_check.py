"""Compare the native picture with the installed gymnasium's: whether they are equal depends on how pygame was built.

Pages: troubleshooting.md.
"""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.box2d import car_racing
from numpy.typing import NDArray

from dreamfleet.worker.worlds.car_racing import ENVIRONMENT
from dreamfleet.worker.worlds.car_racing.environment import PICTURES, CarRacing, is_native_available
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX

_Reference: Any = car_racing.CarRacing  # untyped upstream
log = logging.getLogger(__name__)
QUICK_SEED, QUICK_STEPS = 20_001, 24
CHECK_INTERVAL = 50  # pictures; of an environment that judges, gymnasium draws one in so many too
ActionSource = Callable[[int, NDArray[np.uint8], np.random.Generator], Any]  # step, 64x64 picture


@dataclass(frozen=True)
class Mismatch:
    """The first difference, and the track and step at which it appeared."""

    what: str
    seed: int
    step: int


@cache
def native_is_exact() -> bool:
    """Whether the native picture equals gymnasium's on this machine; checked once per process, in under a second.

    False also where the environment variable `DREAMFLEET_PICTURES` is `gymnasium`.
    """
    if os.environ.get(PICTURES) == "gymnasium":
        return False
    if not is_native_available():
        log.warning("no native picture was built (no C compiler at installation): gymnasium draws, 15 times slower")
        return False
    difference = compare(QUICK_SEED, QUICK_STEPS, random_action)
    if difference is not None:
        log.warning(
            "the native picture differs from the installed gymnasium's (%s): gymnasium draws; pygame-ce or gymnasium "
            "may be another version than the supported ones", difference.what,
        )  # fmt: skip
    return difference is None


def random_action(step: int, _picture: Any, random: np.random.Generator) -> NDArray[np.float32]:
    """A random action with much gas."""
    steer = random.uniform(-1, 1) if step % 2 else 0.1
    return np.array([steer, random.uniform(0.3, 1), random.uniform(0, 0.2)], dtype=np.float32)


def compare(seed: int, steps: int, actions: ActionSource, **settings: Any) -> Mismatch | None:
    """Drive gymnasium's environment and ours side by side; return the first difference, or `None`.

    It compares observation, picture, reward, flags, info, and the state of each body.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # SWIG's, on first import
        theirs, ours = _Reference(**settings), CarRacing(**settings)
        small = CarRacing(**settings, preprocessing=BOX.name)
    random = np.random.default_rng(seed)
    quick = steps <= QUICK_STEPS
    try:
        results = [each.reset(seed=seed) for each in (theirs, ours, small)]
        for step in range(steps):
            if what := find_mismatch(results, (theirs, ours, small)):
                return Mismatch(what, seed, step)
            if step and results[0][2]:
                return None
            action = actions(step, results[2][0], random)
            results = [each.step(action) for each in (theirs, ours, small)]
            if quick and step % 8 == 7:
                for each in (theirs, ours, small):
                    each.t += 0.4  # shortens the opening zoom, which lasts a second
        return None
    finally:
        for each in (theirs, ours, small):
            each.close()


def find_mismatch(results: list[Any], environments: tuple[Any, ...]) -> str | None:
    """Describe what differs between gymnasium's result and ours; `None` if nothing does."""
    reference, ours, small = results
    if not np.array_equal(reference[0], ours[0]):
        return f"observation, {int((reference[0] != ours[0]).any(axis=-1).sum())} pixels"
    if not np.array_equal(BOX.picture(reference[0]), small[0]):
        return "picture"
    if reference[1:] != ours[1:] or reference[1:] != small[1:]:
        return "reward, flags or info"
    states = [list(body_state(each)) for each in environments]
    return None if states[0] == states[1] == states[2] else "body state"


def body_state(environment: Any) -> Iterator[tuple[float, ...]]:
    """Yield position, angle and velocities of the hull and each wheel."""
    car = environment.car
    for body in (car.hull, *car.wheels):
        yield (*body.position, body.angle, *body.linearVelocity, body.angularVelocity)
    for wheel in car.wheels:
        yield (wheel.omega, wheel.phase, wheel.gas, wheel.brake)


def make_car_racing(**settings: Any) -> gymnasium.Env[Any, Any]:
    """Make `dreamfleet/CarRacing-v3`, drawn natively where that is exact, else by gymnasium."""
    return gymnasium.make(ENVIRONMENT, native=native_is_exact(), disable_env_checker=True, **settings)
