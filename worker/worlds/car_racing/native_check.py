"""Compare the native environment with the installed gymnasium's, or with hashes of drives in it; make either.

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
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX, RAW

log = logging.getLogger(__name__)
QUICK_SEED, QUICK_STEPS = 20_001, 24
DRIVEN_STEPS = 120
MANNERS: dict[str, dict[str, Any]] = {
    "random": {}, "colours": {"domain_randomize": True}, "discrete": {"continuous": False}, "leaving": {}, "driven": {},
}  # fmt: skip
TRUTHS = {  # of gymnasium and Box2D, a hash each seed: `python -m tests.worker.worlds.car_racing.truth --hashes`
    "random": "11d5707 d817cb8 6bd5a0e 60b13b8 77bfd0c e21bccc a6dcd63 dd18743 eb48b8a 22ee79a 445450d 06a5af9",
    "colours": "94212a2 a5e938a d680c19 f179c8c 12a8278 02a2769 847c4f1 ae885bd 0d7de62 c4cd2b6 a5e023a fbf6b95",
    "discrete": "3174c7b 7dbc63d b6b19c8 2e14332 f2ae059 2e64e81 2b1c17a 44cb978 cae145d a801376 050d330 c50769b",
    "leaving": "846ec52 bfde250 2ead773 60dc838 e4833c2 88e65d6 1325c2f 32b6766 9a36813 524abc9 a9f6eb3 839bd6c",
    "driven": "0f883dc 7679827 67dcfd0 5f12114 2aa44d4 e384a73 bc47e33 7a1dc5b b46f292 2fc52d1 d3fcc8f 95ccd5a",
}
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

    Where Box2D or pygame cannot be imported, a hash of most manners decides: `DreamfleetError` if one differs.
    False also where the environment variable `DREAMFLEET_PICTURES` is `gymnasium`.
    """
    if os.environ.get(PICTURES) == "gymnasium":
        return False
    if not is_native_available():
        log.warning("nothing native was built (no C compiler at installation): gymnasium drives, 15 times slower")
        return False
    if find_reference() is None:
        for seed, manner in enumerate(list(MANNERS)[:-1]):  # the last takes longer
            if (found := hash_drive(CarRacing, manner, seed)) != (truth := TRUTHS[manner].split()[seed]):
                raise DreamfleetError(
                    f"this host computes another drive ({found}) than gymnasium and Box2D on x86-64 ({truth}): install "
                    "box2d and pygame-ce, and gymnasium drives; please report this, with the processor's name"
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
    return "gymnasium" if find_reference() else "the native core, checked by the hashes of drives in gymnasium 1.4.0"


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


def hash_drive(make: Callable[..., Any], manner: str, seed: int) -> str:
    """The hash of a short drive in an environment: pictures, rewards and the state of each body."""
    environment, digest = make(**MANNERS[manner], preprocessing=(RAW, BOX)[seed % 2].name), hashlib.sha256()

    def act(step: int, picture: NDArray[np.uint8], random: np.random.Generator) -> Any:
        if step == 0 and manner == "leaving":
            environment.place(-1.5, 332.9, 40.0 * seed)  # at the field's edge
        if manner == "discrete":
            return int(random.integers(5))
        return _follow(environment) if manner == "driven" else random_action(step, picture, random)

    for ((picture, *rest),) in drive((environment,), seed, DRIVEN_STEPS if manner == "driven" else QUICK_STEPS, act):
        state = [value for row in body_state(environment) for value in row] + [rest[0] if rest[1:] else 0.0]
        digest.update(picture.tobytes() + struct.pack(f"<{len(state)}d", *state) + repr(rest[1:]).encode())
    return digest.hexdigest()[:7]


def _follow(environment: Any) -> NDArray[np.float32]:
    """An action along the road, which no library's sine decides."""
    (x, y), (left, right, *_) = environment.car.hull.position, (wheel.position for wheel in environment.car.wheels)
    points = np.array(environment.track)[:, 2:] - (x, y)
    to_x, to_y = points[(int((points**2).sum(axis=1).argmin()) + 3) % len(points)]
    front_x, front_y = (left[0] + right[0]) / 2 - x, (left[1] + right[1]) / 2 - y
    turn = 2 * (to_x * front_y - to_y * front_x) / (abs(to_x) + abs(to_y))
    return np.array([min(max(turn, -1), 1), 0.6, 0], np.float32)


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
