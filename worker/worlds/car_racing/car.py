"""The native race's car under the names that gymnasium's car and Box2D's bodies have."""

from __future__ import annotations

from typing import NamedTuple

from dreamfleet.worker.worlds.car_racing import _native

HULL = 4  # bodies 0 to 3 are the wheels


class Joint(NamedTuple):
    """What holds a wheel: how far it is turned against the hull."""

    angle: float


class Body(NamedTuple):
    """The hull or a wheel, in metres, radians and seconds; what only wheels have follows, with the tiles under it."""

    position: tuple[float, float]
    angle: float
    linearVelocity: tuple[float, float]  # noqa: N815 - Box2D's name
    angularVelocity: float  # noqa: N815 - Box2D's name
    omega: float = 0.0
    phase: float = 0.0
    gas: float = 0.0
    brake: float = 0.0
    steer: float = 0.0
    joint: Joint = Joint(0.0)
    tiles: int = 0


class Car(NamedTuple):
    """The hull and its wheels, the front ones first, at one moment."""

    hull: Body
    wheels: tuple[Body, ...]


def read_car(race: _native.Race) -> Car:
    """The car of a race as it is now."""
    return Car(_read_body(race, HULL), tuple(_read_wheel(race, index) for index in range(HULL)))


def _read_body(race: _native.Race, index: int) -> Body:
    x, y, angle, vx, vy, spin, _ = race.body(index)
    return Body((x, y), angle, (vx, vy), spin)


def _read_wheel(race: _native.Race, index: int) -> Body:
    omega, phase, gas, brake, steer, angle, tiles = race.wheel(index)
    return Body(*_read_body(race, index)[:4], omega, phase, gas, brake, steer, Joint(angle), tiles)
