"""gymnasium's car and contact listener in the native module: the same arithmetic in the same order, but faster.

gymnasium's loop works on NumPy scalars and queries Box2D for both axes of each wheel. `native/roll.c` makes the same
IEEE operations, so forces and the state of each body are equal to the bit; `native_check` compares them. The native
module reads bodies and contacts where Box2D keeps them, if they lie there as it assumes: `find_native` tries that once.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from functools import cache
from types import ModuleType
from typing import Any

import Box2D
from gymnasium.envs.box2d import car_dynamics, car_racing

try:
    from dreamfleet.worker.worlds.car_racing import _native
except ImportError:  # no compiler when this was installed
    _native = None  # type: ignore[assignment]

_Base: Any = car_dynamics.Car  # untyped upstream
_Listener: Any = car_racing.FrictionDetector  # untyped upstream
log = logging.getLogger(__name__)
STIFFNESS = 205_000


class Car(_Base):  # type: ignore[misc]
    """A car whose controls are plain floats. Assigning `__class__` turns gymnasium's car into one."""

    def steer(self, s: float) -> None:
        """Turn the front wheels towards `s`, -1 to 1."""
        left, right, *_ = self.wheels
        left.steer = right.steer = float(s)

    def gas(self, gas: float) -> None:
        """Give gas, clipped to 0 to 1; it rises by at most 0.1 a step and falls at once."""
        gas = min(max(float(gas), 0.0), 1.0)
        for wheel in self.wheels[2:4]:
            more = gas - wheel.gas
            wheel.gas += more if more < 0.1 else 0.1

    def brake(self, b: float) -> None:
        """Brake all wheels; 0.9 or more locks them."""
        b = float(b)
        for wheel in self.wheels:
            wheel.brake = b

    def step(self, dt: float) -> None:
        """Turn the wheels and apply their forces for `dt` seconds; the physics step follows."""
        scale = STIFFNESS * car_dynamics.SIZE * car_dynamics.SIZE
        engine, inertia = car_dynamics.ENGINE_POWER, car_dynamics.WHEEL_MOMENT_OF_INERTIA
        _native.roll(self, dt, scale, engine, inertia, car_dynamics.FRICTION_LIMIT)

    def skid(self, wheel: Any, grass: bool) -> None:
        """Extend the wheel's skid mark, which `rgb_array` and `human` draw, or begin another; `roll.c` calls it."""
        trace = wheel.skid_particle
        if trace and trace.grass == grass and len(trace.poly) < 30:
            position = wheel.position
            trace.poly.append((position.x, position.y))
        elif wheel.skid_start is None:
            wheel.skid_start = wheel.position
        else:
            wheel.skid_particle = self._create_particle(wheel.skid_start, wheel.position, grass)
            wheel.skid_start = None


class Listener(_Listener):  # type: ignore[misc]
    """Notes which wheels touch which tiles. Assigning `__class__` turns gymnasium's listener into one."""

    def BeginContact(self, contact: Any) -> None:  # noqa: N802 - Box2D's name
        """A wheel or the hull comes upon a tile."""
        _native.touch(self, contact, True)

    def EndContact(self, contact: Any) -> None:  # noqa: N802 - Box2D's name
        """It leaves the tile."""
        _native.touch(self, contact, False)


class _Trial(Box2D.b2ContactListener):  # type: ignore[misc]
    """Notes whether the native module knows how the contacts and bodies lie in memory."""

    known: bool | None = None

    def BeginContact(self, contact: Any) -> None:  # noqa: N802 - Box2D's name
        with suppress(Exception):
            self.known = self.known is not False and _native.knows(contact)


@cache
def find_native() -> ModuleType | None:
    """The native module; `None` if it was not built, or if this Box2D lays out its bodies in another way."""
    if _native is None:
        return None
    trial = _Trial()
    world = Box2D.b2World(gravity=(0, 0), contactListener=trial)
    for turn in (1, 2):
        body = world.CreateDynamicBody(
            position=(0.25 * turn, -0.5 * turn), angle=0.75 * turn, linearVelocity=(3.5 * turn, -4.5),
            angularVelocity=turn, fixtures=Box2D.b2FixtureDef(shape=Box2D.b2PolygonShape(box=(2, 3)), density=1.0),
        )  # fmt: skip
        body.userData = body
    world.Step(0.02, 1, 1)
    if not trial.known:
        log.warning("this Box2D keeps its bodies in another way than is known here: gymnasium drives and draws")
        return None
    return _native
