"""gymnasium's car, stepped in plain floats: the same arithmetic in the same order, at less than half the price.

gymnasium's loop works on numpy scalars and asks Box2D for both axes of each wheel. Every operation here is the same
IEEE operation, so forces, and with them every body's state, keep their bits; `car_racing.check` holds them to it.
"""

from __future__ import annotations

import math
from typing import Any

from gymnasium.envs.box2d import car_dynamics

_Base: Any = car_dynamics.Car  # untyped upstream
STIFFNESS = 205_000
BRAKE = 15.0  # radians a second
SPIN_UP = car_dynamics.ENGINE_POWER
INERTIA = car_dynamics.WHEEL_MOMENT_OF_INERTIA
ROAD = car_dynamics.FRICTION_LIMIT
GRASS = ROAD * 0.6


def sign(value: float) -> int:
    """1, 0 or -1."""
    return (value > 0) - (value < 0)


class Car(_Base):  # type: ignore[misc]
    """A car whose controls and steps are plain floats. An existing car becomes one by its `__class__`."""

    def steer(self, s: float) -> None:
        """Turn the front wheels towards `s`, -1 to 1."""
        super().steer(float(s))

    def gas(self, gas: float) -> None:
        """Give gas, clipped to 0 to 1; it comes gradually and goes at once."""
        gas = min(max(float(gas), 0.0), 1.0)
        for wheel in self.wheels[2:4]:
            wheel.gas += min(gas - wheel.gas, 0.1)

    def brake(self, b: float) -> None:
        """Brake all wheels; from 0.9 on they are locked."""
        super().brake(float(b))

    def step(self, dt: float) -> None:
        """Move wheels and apply their forces for `dt` seconds; the world's step follows."""
        scale = STIFFNESS * car_dynamics.SIZE * car_dynamics.SIZE
        for wheel in self.wheels:
            joint = wheel.joint
            turn = wheel.steer - joint.angle
            joint.motorSpeed = sign(turn) * min(50.0 * abs(turn), 3.0)
            tiles = wheel.tiles
            limit = max(GRASS, *(ROAD * tile.road_friction for tile in tiles)) if tiles else GRASS

            side = wheel.GetWorldVector((1, 0))
            cosine, sine = side.x, side.y  # forwards is (-sine, cosine)
            velocity = wheel.linearVelocity
            vx, vy = velocity.x, velocity.y
            ahead = -sine * vx + cosine * vy

            omega, power = wheel.omega, dt * SPIN_UP * wheel.gas
            omega += power / INERTIA / (abs(omega) + 5.0)
            self.fuel_spent += power
            brake = wheel.brake
            if brake >= 0.9:
                omega = 0.0
            elif brake > 0:
                omega -= sign(omega) * min(BRAKE * brake, abs(omega))
            wheel.phase += omega * dt

            forwards = (-ahead + omega * wheel.wheel_rad) * scale
            sideways = -(cosine * vx + sine * vy) * scale
            force = math.sqrt(forwards * forwards + sideways * sideways)
            if force > 2.0 * limit:
                self._skid(wheel, not tiles)
            else:
                wheel.skid_start = wheel.skid_particle = None
            if force > limit:
                forwards = forwards / force * limit
                sideways = sideways / force * limit
            wheel.omega = omega - dt * forwards * wheel.wheel_rad / INERTIA
            wheel.ApplyForceToCenter((sideways * cosine + forwards * -sine, sideways * sine + forwards * cosine), True)

    def _skid(self, wheel: Any, grass: bool) -> None:
        """Lengthen the wheel's trace, which `rgb_array` and `human` show, or begin another."""
        trace = wheel.skid_particle
        if trace and trace.grass == grass and len(trace.poly) < 30:
            trace.poly.append((wheel.position[0], wheel.position[1]))
        elif wheel.skid_start is None:
            wheel.skid_start = wheel.position
        else:
            wheel.skid_particle = self._create_particle(wheel.skid_start, wheel.position, grass)
            wheel.skid_start = None
