"""The true state of car and road in CarRacing's simulator, with which world models are compared.

Lengths are in the simulator's metres, angles in radians, times in seconds. Positive means left of the centre line,
turned left, or curving left, as in Box2D; tracks run counter-clockwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

LOOK_AHEAD = (5, 10, 20, 30, 40)  # metres along the centre line
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TrackPosition:
    """A point relative to the centre line: distance along it, offset to its left, and the line's heading there."""

    along: float
    offset: float
    heading: float


@dataclass(frozen=True)
class CentreLine:
    """A closed track: `points` (N, 2), their `heading` (N,), the distance `along` (N + 1,) to each and all around."""

    points: Floats
    heading: Floats
    along: Floats

    @classmethod
    def of(cls, track: Any) -> CentreLine:
        """Convert gymnasium's track: alpha, heading, x and y of each point; a heading of 0 points along y."""
        rows = np.asarray(track, dtype=np.float64)
        points = rows[:, 2:4]
        lengths = np.hypot(*(np.roll(points, -1, axis=0) - points).T)
        return cls(points, rows[:, 1], np.concatenate([[0.0], np.cumsum(lengths)]))

    def nearest_position(self, x: float, y: float) -> TrackPosition:
        """Return the nearest position on the line to a point."""
        at = np.array([x, y])
        ways = np.roll(self.points, -1, axis=0) - self.points
        squares = np.maximum((ways**2).sum(axis=1), 1e-12)
        shares = np.clip(((at - self.points) * ways).sum(axis=1) / squares, 0, 1)
        away = at - (self.points + shares[:, None] * ways)
        row = int((away**2).sum(axis=1).argmin())
        side = ways[row, 0] * away[row, 1] - ways[row, 1] * away[row, 0]
        share = float(shares[row])
        along = self.along[row] + share * (self.along[row + 1] - self.along[row])
        turned = wrap_angle(self.heading[(row + 1) % len(self.heading)] - self.heading[row])
        offset, heading = math.copysign(math.hypot(*away[row]), side), self.heading[row] + share * turned
        return TrackPosition(float(along), offset, float(heading))

    def curvature(self, along: Any) -> Floats:
        """The curvature `(K,)` at distances `along` (K,), in radians per metre, interpolated between the points."""
        turned = wrap_angle(np.roll(self.heading, -1) - np.roll(self.heading, 1))
        lengths = np.diff(self.along)
        bends = turned / (lengths + np.roll(lengths, 1))
        places = np.asarray(along, dtype=np.float64) % self.along[-1]
        found: Floats = np.interp(places, self.along, np.append(bends, bends[0]))
        return found


@lru_cache(maxsize=4)
def centre_line(track: tuple[tuple[float, ...], ...]) -> CentreLine:
    """The centre line of gymnasium's track; cached, because each step needs it."""
    return CentreLine.of(track)


def read_true_state(environment: Any) -> dict[str, float]:
    """Read the true state at the last observation from a CarRacing environment, gymnasium's or ours.

    `side_slip` is the speed to the car's left; `off_road` is 1 while no wheel touches a road tile, else 0.
    """
    car, line = environment.car, centre_line(tuple(environment.track))
    hull = car.hull
    nearest_position = line.nearest_position(*hull.position)
    velocity, left = hull.linearVelocity, (-math.cos(hull.angle), -math.sin(hull.angle))
    ahead = line.curvature([nearest_position.along + distance for distance in LOOK_AHEAD])
    return {
        "lateral_offset": nearest_position.offset,
        "heading_error": float(wrap_angle(hull.angle - nearest_position.heading)),
        "yaw_rate": float(hull.angularVelocity),
        "wheel_angle": float(np.mean([wheel.joint.angle for wheel in car.wheels[:2]])),
        "speed": math.hypot(*velocity),
        "side_slip": velocity[0] * left[0] + velocity[1] * left[1],
        **{f"curvature_{distance}m": float(bend) for distance, bend in zip(LOOK_AHEAD, ahead, strict=True)},
        "off_road": float(not any(wheel.tiles for wheel in car.wheels)),
    }


def wrap_angle(angle: Any) -> Any:
    """The same angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
