"""gymnasium's car with its wheel physics in the native module: the same arithmetic in the same order, but faster.

gymnasium's loop works on NumPy scalars and queries Box2D for both axes of each wheel. `native/roll.c` makes the same
IEEE operations, so forces and the state of each body are equal to the bit; `native_check` compares them.
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
    """A car whose controls are plain floats. Assigning `__class__` turns gymnasium's car into one."""

    def steer(self, s: float) -> None:
        """Turn the front wheels towards `s`, -1 to 1."""
        super().steer(float(s))

    def gas(self, gas: float) -> None:
        """Give gas, clipped to 0 to 1; it rises by at most 0.1 a step and falls at once."""
        gas = min(max(float(gas), 0.0), 1.0)
        for wheel in self.wheels[2:4]:
            more = gas - wheel.gas
            wheel.gas += more if more < 0.1 else 0.1

    def brake(self, b: float) -> None:
        """Brake all wheels; 0.9 or more locks them."""
        super().brake(float(b))

    def step(self, dt: float) -> None:
        """Turn the wheels and apply their forces for `dt` seconds; the physics step follows."""
        scale = STIFFNESS * car_dynamics.SIZE * car_dynamics.SIZE
        engine, inertia = car_dynamics.ENGINE_POWER, car_dynamics.WHEEL_MOMENT_OF_INERTIA
        _native.roll(self, dt, scale, engine, inertia, car_dynamics.FRICTION_LIMIT)

    def skid(self, wheel: Any, grass: bool) -> None:
        """Extend the wheel's skid mark, which `rgb_array` and `human` draw, or begin another; `roll.c` calls it."""
        trace = wheel.skid_particle
        if trace and trace.grass == grass and len(trace.poly) < 30:
            trace.poly.append((wheel.position[0], wheel.position[1]))
        elif wheel.skid_start is None:
            wheel.skid_start = wheel.position
        else:
            wheel.skid_particle = self._create_particle(wheel.skid_start, wheel.position, grass)
            wheel.skid_start = None
