"""The native race's car under the names that gymnasium's car and Box2D's bodies have."""

from __future__ import annotations

from typing import NamedTuple

from dreamfleet.worker.worlds.car_racing._native import Race

HULL = 4  # bodies 0 to 3 are the wheels
Pair = tuple[float, float]


class Body(NamedTuple):
    """The hull: metres, radians and seconds."""

    position: Pair
    angle: float
    linearVelocity: Pair  # noqa: N815 - Box2D's name
    angularVelocity: float  # noqa: N815 - Box2D's name


class Joint(NamedTuple):
    """What holds a wheel: how far it is turned against the hull."""

    angle: float


class CarWheel(NamedTuple):
    """A wheel as a body, how it turns, and on how many tiles it stands."""

    position: Pair
    angle: float
    linearVelocity: Pair  # noqa: N815 - Box2D's name
    angularVelocity: float  # noqa: N815 - Box2D's name
    omega: float
    phase: float
    gas: float
    brake: float
    steer: float
    joint: Joint
    tiles: int


class Car(NamedTuple):
    """The hull and its wheels, the front ones first, at one moment."""

    hull: Body
    wheels: tuple[CarWheel, ...]


def read_car(race: Race) -> Car:
    """The car of a race as it is now."""
    bodies = [Body((x, y), angle, (vx, vy), spin) for x, y, angle, vx, vy, spin, _ in map(race.body, range(HULL + 1))]
    turning = map(race.wheel, range(HULL))
    wheels = (
        CarWheel(*body, omega, phase, gas, brake, steer, Joint(angle), tiles)
        for body, (omega, phase, gas, brake, steer, angle, tiles) in zip(bodies, turning, strict=False)
    )
    return Car(bodies[HULL], tuple(wheels))
