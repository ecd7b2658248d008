"""gymnasium's car, whose wheels the native module rolls: the same arithmetic in the same order, for far less.

gymnasium's loop works on numpy scalars and asks Box2D for both axes of each wheel. Every operation of `native/roll.c`
is the same IEEE operation, so forces, and with them every body's state, keep their bits; `car_racing.check` holds them
to it.
"""

from __future__ import annotations

from typing import Any

from gymnasium.envs.box2d import car_dynamics

try:
    from dreamfleet.worker.car_racing import _native
except ImportError:  # no compiler when this was installed
    _native = None  # type: ignore[assignment]

_Base: Any = car_dynamics.Car  # untyped upstream
STIFFNESS = 205_000


class Car(_Base):  # type: ignore[misc]
    """A car whose controls are plain floats. An existing car becomes one by its `__class__`."""

    def steer(self, s: float) -> None:
        """Turn the front wheels towards `s`, -1 to 1."""
        super().steer(float(s))

    def gas(self, gas: float) -> None:
        """Give gas, clipped to 0 to 1; it comes gradually and goes at once."""
        gas = min(max(float(gas), 0.0), 1.0)
        for wheel in self.wheels[2:4]:
            more = gas - wheel.gas
            wheel.gas += more if more < 0.1 else 0.1

    def brake(self, b: float) -> None:
        """Brake all wheels; from 0.9 on they are locked."""
        super().brake(float(b))

    def step(self, dt: float) -> None:
        """Move wheels and apply their forces for `dt` seconds; the world's step follows."""
        scale = STIFFNESS * car_dynamics.SIZE * car_dynamics.SIZE
        engine, inertia = car_dynamics.ENGINE_POWER, car_dynamics.WHEEL_MOMENT_OF_INERTIA
        _native.roll(self, dt, scale, engine, inertia, car_dynamics.FRICTION_LIMIT)

    def skid(self, wheel: Any, grass: bool) -> None:
        """Lengthen the wheel's trace, which `rgb_array` and `human` show, or begin another."""
        trace = wheel.skid_particle
        if trace and trace.grass == grass and len(trace.poly) < 30:
            trace.poly.append((wheel.position[0], wheel.position[1]))
        elif wheel.skid_start is None:
            wheel.skid_start = wheel.position
        else:
            wheel.skid_particle = self._create_particle(wheel.skid_start, wheel.position, grass)
            wheel.skid_start = None
