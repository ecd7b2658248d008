"""Drives gymnasium's CarRacing and the native `Race` side by side without pictures and compares all of their state.

`python -m tests.worker.worlds.car_racing.truth --steps 200000` alternates manners of driving and tracks, and prints the
first difference: its step, what it is of, and both values.
"""

from __future__ import annotations

import argparse
import math
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.envs.box2d import car_racing

from dreamfleet.worker.worlds.car_racing import _native
from dreamfleet.worker.worlds.car_racing.true_state import centre_line, wrap_angle

_Base: Any = car_racing.CarRacing  # untyped upstream
Action = tuple[float, float, float]
Driver = Callable[[int], Action]
FIELDS = ("x", "y", "angle", "velocity x", "velocity y", "spin", "awake")
WHEEL_FIELDS = ("omega", "phase", "gas", "brake", "steer", "joint angle", "tiles")
HULL = 4


class Blind(_Base):  # type: ignore[misc]
    """gymnasium's CarRacing that draws nothing."""

    def _render(self, mode: str) -> None:
        return None


@dataclass(frozen=True)
class Difference:
    """What differed first."""

    step: int
    what: str
    theirs: Any
    ours: Any


def tile_corners(environment: Any) -> np.ndarray[Any, Any]:
    """The tiles' corners `(N, 4, 2)`: the road's polygons but for its borders."""
    colours = {id(tile.color) for tile in environment.road}
    return np.array([corners for corners, colour in environment.road_poly if id(colour) in colours], np.float64)


def start(race: Any, environment: Any) -> None:
    """Begin the episode that gymnasium has begun."""
    lap = environment.lap_complete_percent
    race.reset(tile_corners(environment), tuple(map(float, environment.track[0][1:4])), lap)


def their_state(environment: Any) -> Iterator[tuple[str, Any]]:
    """Everything that is compared, named."""
    car = environment.car
    for index, body in enumerate((*car.wheels, car.hull)):
        numbers = (*body.position, body.angle, *body.linearVelocity, body.angularVelocity, body.awake)
        yield from zip((f"body {index} {field}" for field in FIELDS), numbers, strict=True)
    for index, wheel in enumerate(car.wheels):
        numbers = (wheel.omega, wheel.phase, wheel.gas, wheel.brake, wheel.steer, wheel.joint.angle, len(wheel.tiles))
        yield from zip((f"wheel {index} {field}" for field in WHEEL_FIELDS), numbers, strict=True)
    yield "reward so far", environment.reward
    yield "time", environment.t
    yield "tiles visited", environment.tile_visited_count
    yield "new lap", environment.new_lap


def our_state(race: Any) -> Iterator[tuple[str, Any]]:
    """The same of the native race."""
    for index in range(HULL + 1):
        yield from zip((f"body {index} {field}" for field in FIELDS), race.body(index), strict=True)
    for index in range(HULL):
        yield from zip((f"wheel {index} {field}" for field in WHEEL_FIELDS), race.wheel(index), strict=True)
    yield from zip(("reward so far", "time", "tiles visited", "new lap"), race.score(), strict=True)


def their_tiles(environment: Any) -> bytes:
    """A byte for each tile, as `Race.tiles`."""
    on = [{tile.idx for tile in wheel.tiles} for wheel in environment.car.wheels]
    plain = environment.road_color
    return bytes(
        sum((tile.idx in wheel) << bit for bit, wheel in enumerate(on))
        | bool(tile.road_visited) << 4
        | (tile.idx % 3 == 0 or bool((tile.color == plain).all())) << 5
        for tile in environment.road
    )


def their_contacts(environment: Any) -> list[tuple[int, int, bool]]:
    """Box2D's contacts, the newest first, as `Race.contacts`."""
    car = environment.car
    movers = sorted(car.hull.fixtures, key=lambda fixture: -max(y for _, y in fixture.shape.vertices))
    movers += [wheel.fixtures[0] for wheel in car.wheels]
    found = []
    for contact in reversed(environment.world.contacts):  # given with the oldest first
        first, second = contact.fixtureA, contact.fixtureB
        road = first.body.userData is not None and hasattr(first.body.userData, "road_friction")
        tile, mover = (first, second) if road else (second, first)
        found.append((tile.body.userData.idx, movers.index(mover), road))
    return found


def bits(value: Any) -> bytes:
    """A number's bits: 0.0 and -0.0 differ."""
    return struct.pack("d", float(value))


def compare_state(step: int, environment: Any, race: Any, tiles: bool) -> Difference | None:
    """The first difference of state; tiles cost more than the rest."""
    for (name, theirs), (_, ours) in zip(their_state(environment), our_state(race), strict=True):
        if bits(theirs) != bits(ours):
            return Difference(step, name, theirs, ours)
    if tiles:
        first = (0 | 1 << 5).__or__
        ours = bytes(first(flags) if index % 3 == 0 else flags for index, flags in enumerate(race.tiles()))
        if (theirs := their_tiles(environment)) != ours:
            index = next(i for i, pair in enumerate(zip(theirs, ours, strict=True)) if pair[0] != pair[1])
            return Difference(step, f"tile {index}", theirs[index], ours[index])
        if (found := their_contacts(environment)) != (known := race.contacts()):
            return Difference(step, "contacts", found, known)
    return None


def race_against(
    environment: Any, race: Any, seed: int, drive: Driver, steps: int, counts: Counter[str], beyond: bool = False
) -> Difference | None:
    """One episode, or with `beyond` all the steps, whatever it says of its end; the first difference."""
    environment.reset(seed=seed)
    start(race, environment)
    difference = compare_state(0, environment, race, tiles=True)
    for step in range(1, steps + 1):
        if difference:
            break
        action = drive(step)
        _, reward, over, _, info = environment.step(np.array(action, np.float64))
        ours = race.step(*action)
        told = (float(reward), info.get("lap_finished"))
        difference = compare_state(step, environment, race, tiles=over or step % 10 == 0)
        if bits(told[0]) != bits(ours[0]) or told[1] is not ours[1]:
            difference = Difference(step, "reward and end", told, ours)
        counts["steps"] += 1
        counts["steps asleep"] += not race.body(HULL)[-1]
        if over and not beyond:
            break
    counts["laps"] += environment.new_lap or environment.tile_visited_count == len(environment.track)
    counts["fields left"] += max(map(abs, environment.car.hull.position)) > car_racing.PLAYFIELD
    return difference


# ---- manners of driving ----


def wild(environment: Any, random: np.random.Generator) -> Driver:
    """Every step another action."""
    return lambda _: (random.uniform(-1, 1), random.uniform(0, 1), random.choice([0, random.uniform(0, 1)]))


def held(environment: Any, random: np.random.Generator) -> Driver:
    """Actions held for a while, within the bounds or at them."""
    now: list[Action] = []

    def drive(step: int) -> Action:
        if step % 15 == 1:
            drawn = random.uniform((-1, 0, 0), 1)
            now[:] = [tuple(np.rint(drawn) if random.random() < 0.4 else drawn)]
        return now[0]

    return drive


def away(environment: Any, random: np.random.Generator) -> Driver:
    """Straight across the grass until the field ends."""
    gas = random.uniform(0.3, 1)
    return lambda _: (0.0, gas, 0.0)


def at_rest(environment: Any, random: np.random.Generator) -> Driver:
    """A push, then nothing: the car comes to rest and sleeps, and is pushed again much later."""
    return lambda step: (random.uniform(-1, 1), 0.5, 0.0) if step % 900 < 20 else (0.0, 0.0, float(step % 900 > 300))


def extreme(environment: Any, random: np.random.Generator) -> Driver:
    """Numbers that no action space has."""
    sizes = [0.0, -0.0, 1.0, 3.0, 1e3, 1e30]
    return lambda step: tuple(random.choice([-1, 1], 3) * random.choice(sizes, 3))


def still(environment: Any, random: np.random.Generator) -> Driver:
    """Nothing at all."""
    return lambda _: (0.0, 0.0, 0.0)


def follow(environment: Any, random: np.random.Generator) -> Driver:
    """Along the track, to the end of a lap."""
    fast, ahead = random.uniform(25, 60), random.uniform(6, 12)

    def drive(_: int) -> Action:
        line, hull = centre_line(tuple(environment.track)), environment.car.hull
        here = line.nearest_position(*hull.position)
        index = int(np.searchsorted(line.along, (here.along + ahead) % line.along[-1])) % len(line.points)
        aim = line.points[index] - np.array(hull.position)
        error = float(wrap_angle(math.atan2(-aim[0], aim[1]) - hull.angle))
        speed = math.hypot(*hull.linearVelocity)
        wanted = fast / (1 + 3 * abs(error))
        return (float(np.clip(-2 * error, -1, 1)), float(speed < wanted), 0.3 * (speed > wanted + 5))

    return drive


MANNERS = {
    "follow": follow,
    "wild": wild,
    "held": held,
    "away": away,
    "at rest": at_rest,
    "extreme": extreme,
    "still": still,
}
LONGEST = {"follow": 3000, "at rest": 3000, "still": 300, "away": 1500}
BEYOND = ("away", "extreme", "follow")  # every other one of these drives on after its end


def compare(steps: int, seed: int = 1, fresh_every: int = 9) -> tuple[Counter[str], Difference | None]:
    """Alternate tracks and manners for so many steps: what happened, and the first difference.

    An environment lives for `fresh_every` episodes, for gymnasium's world keeps traces of those before.
    """
    counts: Counter[str] = Counter()
    difference = None
    environment: Any = None
    race: Any = None
    while counts["steps"] < steps and difference is None:
        episode = counts["episodes"]
        if episode % fresh_every == 0:
            environment, race = Blind(lap_complete_percent=(0.95, 0.3)[episode % 2]), _native.Race()
        name = list(MANNERS)[episode % len(MANNERS)]
        drive = MANNERS[name](environment, np.random.default_rng(seed + episode))
        beyond = name in BEYOND and episode // len(MANNERS) % 2 == 1
        difference = race_against(environment, race, seed + episode, drive, LONGEST.get(name, 1000), counts, beyond)
        if difference:
            print(f"{name}, seed {seed + episode}, episode {episode % fresh_every} of its environment")
        counts["episodes"] += 1
    return counts, difference


def time_both(steps: int, seed: int = 5, block: int = 50) -> tuple[float, float]:
    """Microseconds a step of Box2D and gymnasium's car without a picture, and of the native race, in turns."""
    environment, race = Blind(), _native.Race()
    spent = [0.0, 0.0]
    random = np.random.default_rng(seed)
    done = 0
    while done < steps:
        environment.reset(seed=seed + done)
        start(race, environment)
        drive = held(environment, random)
        for first in range(1, 1000, block):
            actions = [drive(step) for step in range(first, first + block)]
            arrays = [np.array(action) for action in actions]
            begin = time.process_time()
            over = [environment.step(action)[2] for action in arrays][-1]
            middle = time.process_time()
            for action in actions:
                race.step(*action)
            spent[0] += middle - begin
            spent[1] += time.process_time() - middle
            done += block
            if over or done >= steps:
                break
    return spent[0] / done * 1e6, spent[1] / done * 1e6


def main() -> None:
    """Compare, then time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    counts, difference = compare(arguments.steps, arguments.seed)
    print(dict(counts), difference)
    print("Box2D {:.1f} us a step, native {:.1f}".format(*time_both(5_000)))
    raise SystemExit(difference is not None)


if __name__ == "__main__":
    main()
