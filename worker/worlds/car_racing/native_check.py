"""Compare the native environment with the installed gymnasium's, or with the hash of a drive in it; make either.

Pages: troubleshooting.md.
"""

from __future__ import annotations

import hashlib
import logging
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.worker.worlds.car_racing import ENVIRONMENT
from dreamfleet.worker.worlds.car_racing.environment import PICTURES, CarRacing, find_reference, is_native_available
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX

log = logging.getLogger(__name__)
QUICK_SEED, QUICK_STEPS = 20_001, 24
TRUTH = "66c44cadc653497616db877f4324b96efc95dba2bc0d531d2c46e92552b313ba"  # of `hash_drive` with gymnasium and Box2D
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
    """Whether the native environment equals gymnasium's on this machine; checked once per process, in under a second.

    Where Box2D or pygame cannot be imported, the hash of a drive decides: `DreamfleetError` if it is another one.
    False also where the environment variable `DREAMFLEET_PICTURES` is `gymnasium`.
    """
    if os.environ.get(PICTURES) == "gymnasium":
        return False
    if not is_native_available():
        log.warning("nothing native was built (no C compiler at installation): gymnasium drives, 15 times slower")
        return False
    if find_reference() is None:
        if (found := hash_drive(CarRacing(), CarRacing(preprocessing=BOX.name))) != TRUTH:
            raise DreamfleetError(
                f"this host computes another drive ({found[:12]}) than gymnasium and Box2D on x86-64 ({TRUTH[:12]}): "
                "install box2d and pygame-ce, and gymnasium drives; please report this, with the processor's name"
            )
        return True
    difference = compare(QUICK_SEED, QUICK_STEPS, random_action)
    if difference is not None:
        log.warning(
            "the native environment differs from the installed gymnasium's (%s): gymnasium drives; pygame-ce, Box2D or "
            "gymnasium may be another version than the supported ones", difference.what,
        )  # fmt: skip
    return difference is None


def judge_name() -> str:
    """Who judges scores here, as reports say it."""
    return "gymnasium" if find_reference() else "the native core, checked by the hash of a drive in gymnasium 1.4.0"


def random_action(step: int, _picture: Any, random: np.random.Generator) -> NDArray[np.float32]:
    """A random action with much gas."""
    steer = random.uniform(-1, 1) if step % 2 else 0.1
    return np.array([steer, random.uniform(0.3, 1), random.uniform(0, 0.2)], dtype=np.float32)


def compare(seed: int, steps: int, actions: ActionSource, **settings: Any) -> Mismatch | None:
    """Drive gymnasium's environment and ours side by side; return the first difference, or `None`.

    It compares observation, picture, reward, flags, info, and the state of each body.
    """
    theirs, ours = _reference().GymnasiumCarRacing(**settings), CarRacing(**settings)
    environments = theirs, ours, CarRacing(**settings, preprocessing=BOX.name)
    try:
        for step, results in enumerate(drive(environments, seed, steps, actions)):
            if what := find_mismatch(results, environments):
                return Mismatch(what, seed, step)
        return None
    finally:
        for each in environments:
            each.close()


def drive(
    environments: tuple[Any, ...], seed: int, steps: int, actions: ActionSource
) -> Iterator[list[tuple[Any, ...]]]:
    """Drive environments side by side by the pictures of the last one; yield what each gave, at the reset and after."""
    random = np.random.default_rng(seed)
    results = [each.reset(seed=seed) for each in environments]
    yield results
    for step in range(steps):
        action = actions(step, results[-1][0], random)
        results = [each.step(action) for each in environments]
        if steps <= QUICK_STEPS and step % 8 == 7:
            for each in environments:
                each.t += 0.4  # shortens the opening zoom, which lasts a second
        yield results
        if results[0][2]:
            return


def hash_drive(*environments: Any) -> str:
    """The digest of a short drive in environments side by side: pictures, rewards and the state of each body."""
    digest = hashlib.sha256()
    for results in drive(environments, QUICK_SEED, QUICK_STEPS, random_action):
        for environment, (picture, *rest) in zip(environments, results, strict=True):
            state = [value for row in body_state(environment) for value in row]
            digest.update(picture.tobytes() + struct.pack(f"<{len(state)}d", *state) + repr(rest[1:]).encode())
            digest.update(struct.pack("<d", rest[0] if rest[1:] else 0.0))
    return digest.hexdigest()


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
    """Make `dreamfleet/CarRacing-v3`, native where that is exact, else gymnasium's."""
    return gymnasium.make(ENVIRONMENT, native=native_is_exact(), disable_env_checker=True, **settings)


def make_unwrapped(native: bool = True, **settings: Any) -> gymnasium.Env[Any, Any]:
    """What `dreamfleet/CarRacing-v3` is without wrappers: native, or gymnasium's where nothing native was built."""
    if native and is_native_available():
        return CarRacing(**settings)
    made: gymnasium.Env[Any, Any] = _reference().GymnasiumCarRacing(
        **{name: value for name, value in settings.items() if name != "checked"}
    )
    return made


def _reference() -> Any:
    """The module `reference`; `ModuleNotFoundError` or gymnasium's error where Box2D or pygame is missing."""
    return find_reference() or import_module("dreamfleet.worker.worlds.car_racing.reference")
