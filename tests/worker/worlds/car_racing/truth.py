"""Drives gymnasium's CarRacing and ours side by side and compares all of their state, and one picture in so many.

`python -m tests.worker.worlds.car_racing.truth --steps 200000 --pictures 10` alternates manners of driving, settings
and tracks, and prints the first difference: its step, what it is of, and both values. With 0 no picture is drawn.
"""

from __future__ import annotations

import argparse
import math
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.envs.box2d import car_racing

from dreamfleet.worker.worlds.car_racing.environment import CarRacing
from dreamfleet.worker.worlds.car_racing.native_check import MANNERS as MANNERS_OF_HASHES
from dreamfleet.worker.worlds.car_racing.native_check import hash_drive
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX, RAW
from dreamfleet.worker.worlds.car_racing.reference import GymnasiumCarRacing, Shadow
from dreamfleet.worker.worlds.car_racing.true_state import centre_line, wrap_angle

Action = tuple[float, float, float]
Driver = Callable[[int], Action]
FIELDS = ("x", "y", "angle", "velocity x", "velocity y", "spin", "awake")
WHEEL_FIELDS = ("omega", "phase", "gas", "brake", "steer", "joint angle", "tiles")
HASHES = 12  # of each manner
HULL, FAR = 4, 1_000.0  # body; metres, three times the field, within which pictures are compared
SETTINGS: tuple[dict[str, Any], ...] = (
    {}, {"lap_complete_percent": 0.3}, {"domain_randomize": True}, {"continuous": False},
)  # fmt: skip


class Ours(CarRacing):
    """Ours, which draws only for `observe`."""

    def _observe(self) -> Any:
        return None

    def observe(self) -> list[Any]:
        """The observation, and the small picture."""
        return [self._draw(RAW.shape), self._draw(BOX.shape)]


@dataclass(frozen=True)
class Difference:
    """What differed first."""

    step: int
    what: str
    theirs: Any
    ours: Any


def compare_tracks(environment: Any, ours: Ours) -> Difference | None:
    """The first difference of centre line, road and colours."""
    tiles = {id(tile.color): index for index, tile in enumerate(environment.road)}
    road = [([float(each) for corner in corners for each in corner], tiles.get(id(colour)))
            for corners, colour in environment.road_poly]  # fmt: skip
    own = [(list(corners), None if border else tile) for corners, tile, border in ours.race.road()]
    colours = [each.tolist() for each in (environment.road_color, environment.bg_color, environment.grass_color)]
    track = [tuple(map(float, each)) for each in environment.track]
    for (alpha, *_), (our_alpha, *_) in zip(track, ours.track, strict=False):
        if abs(alpha - our_alpha) > math.ulp(2 * math.pi):
            return Difference(0, "alpha", alpha, our_alpha)
    sides = {  # without alpha, which glibc rounds to the other side once in a thousand times
        "track": ([each[1:] for each in track], [each[1:] for each in ours.track]),
        "road": (road, own),
        "colours": (colours, [each.tolist() for each in ours.colours]),
    }
    return next((Difference(0, what, *pair) for what, pair in sides.items() if pair[0] != pair[1]), None)


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


def compare_pictures(step: int, environment: Any, ours: Ours) -> Difference | None:
    """The pixels that differ, if any do."""
    observation = environment.observe()
    for what, theirs, own in zip(("observation", "picture"), (observation, BOX.picture(observation)), ours.observe(),
                                 strict=True):  # fmt: skip
        if found := int((theirs != own).any(axis=-1).sum()):
            return Difference(step, what, found, 0)
    return None


def choice(action: Action) -> int:
    """The discrete action that comes near."""
    steering, gas, brake = action
    return 1 if steering > 0.3 else 2 if steering < -0.3 else 3 if gas > 0.4 else 4 if brake > 0.3 else 0


def race_against(
    environment: Any, ours: Ours, seed: int, drive: Driver, steps: int, counts: Counter[str], beyond: bool = False,
    pictures: int = 0,
) -> Difference | None:  # fmt: skip
    """One episode, or with `beyond` all the steps, whatever it says of its end; the first difference."""
    if environment.domain_randomize:
        ours.colours = (environment.road_color, environment.bg_color, environment.grass_color)
    for each in (environment, ours):
        each.reset(seed=seed, options={"randomize": bool(seed % 4)})
    difference = compare_tracks(environment, ours) or compare_state(0, environment, ours.race, tiles=True)
    for step in range(1, steps + 1):
        if difference:
            break
        action: Any = np.array(drive(step), np.float64) if ours.continuous else choice(drive(step))
        _, reward, over, _, info = environment.step(action)
        _, own_reward, own_over, _, own_info = ours.step(action)
        difference = compare_state(step, environment, ours.race, tiles=over or step % 10 == 0)
        if bits(reward) != bits(own_reward) or (over, info) != (own_over, own_info):
            difference = Difference(step, "reward and end", (reward, over, info), (own_reward, own_over, own_info))
        if pictures and (step + seed) % pictures == 0 and max(map(abs, environment.car.hull.position)) < FAR:
            difference = difference or compare_pictures(step, environment, ours)
            counts["pictures"] += 1
        counts["steps"] += 1
        counts["steps asleep"] += not ours.race.body(HULL)[-1]
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


def compare(
    steps: int, seed: int = 1, pictures: int = 0, fresh_every: int = 9
) -> tuple[Counter[str], Difference | None]:
    """Alternate tracks, manners and settings for so many steps: what happened, and the first difference.

    An environment lives for `fresh_every` episodes, for gymnasium's world keeps traces of those before.
    """
    counts: Counter[str] = Counter()
    difference = None
    environment: Any = None
    ours: Any = None
    while counts["steps"] < steps and difference is None:
        episode = counts["episodes"]
        if episode % fresh_every == 0:
            settings = SETTINGS[(seed + episode // fresh_every) % len(SETTINGS)]
            environment, ours = Shadow(**settings), Ours(**settings)
        name = list(MANNERS)[episode % len(MANNERS)]
        drive = MANNERS[name](environment, np.random.default_rng(seed + episode))
        beyond = name in BEYOND and episode // len(MANNERS) % 2 == 1
        longest = LONGEST.get(name, 1000)
        difference = race_against(environment, ours, seed + episode, drive, longest, counts, beyond, pictures)
        if difference:
            print(f"{name}, seed {seed + episode}, episode {episode % fresh_every} of its environment")
        counts["episodes"] += 1
    return counts, difference


def compare_seeds(seeds: range) -> Difference | None:
    """The first track that differs."""
    environment, ours = Shadow(), Ours()
    for seed in seeds:
        for each in (environment, ours):
            each.reset(seed=seed)
        if difference := compare_tracks(environment, ours) or compare_state(0, environment, ours.race, tiles=True):
            print(f"seed {seed}")
            return difference
    return None


def main() -> None:
    """Compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pictures", type=int, default=0)
    parser.add_argument("--tracks", type=int, default=100)
    parser.add_argument("--hashes", action="store_true", help="print native_check's table instead")
    arguments = parser.parse_args()
    if arguments.hashes:
        for manner in MANNERS_OF_HASHES:
            print(manner, *(hash_drive(GymnasiumCarRacing, manner, seed) for seed in range(HASHES)))
        return
    found = compare_seeds(range(arguments.seed, arguments.seed + arguments.tracks))
    counts, difference = compare(arguments.steps, arguments.seed, arguments.pictures)
    print(dict(counts), found, difference)
    raise SystemExit(bool(found or difference))


if __name__ == "__main__":
    main()
