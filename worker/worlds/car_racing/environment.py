"""gymnasium's CarRacing-v3 with its own track, physics and rewards; our native module draws only the observation.

`rgb_array` and `human` rendering are gymnasium's. If the native module was not built, `native_check` logs that and
gymnasium draws. Environments that judge draw some pictures both ways, and stop at a difference. Pages: platforms.md.
"""

from __future__ import annotations

import math
from array import array
from functools import cache, lru_cache
from typing import Any

import gymnasium
import numpy as np
import pygame
from Box2D import b2Vec2
from gymnasium.envs.box2d import car_dynamics, car_racing
from gymnasium.error import InvalidAction
from numpy.typing import NDArray

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.printable import plural
from dreamfleet.worker.worlds.car_racing.car import Car, Listener, find_native
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX, RAW, find_preprocessing

_native: Any = find_native()
PICTURES = "DREAMFLEET_PICTURES"  # "gymnasium" lets gymnasium draw, in this process and those that it starts
TEXT_WIDTH = 125  # pixels at the window's left edge that hold the score
_Base: Any = car_racing.CarRacing  # untyped upstream


class CarRacing(_Base):  # type: ignore[misc]
    """CarRacing-v3 with its observation drawn natively.

    `preprocessing` names its pictures: `raw-96`, gymnasium's own, or another of `car_racing.preprocessing`. With
    `native` False, or without the native module, gymnasium drives and draws. Like gymnasium's, it is not thread-safe:
    environments of one process share one canvas.

    With `checked` N, gymnasium draws the first and then every Nth picture too; `DreamfleetError` if one differs.
    """

    prev_reward: float  # gymnasium's

    def __init__(
        self, *arguments: Any, preprocessing: str = RAW.name, native: bool = True, checked: int = 0, **more: Any
    ) -> None:
        super().__init__(*arguments, **more)
        own = {"preprocessing": preprocessing, "native": native, "checked": checked}
        gymnasium.utils.EzPickle.__init__(self, *arguments, **own, **more)  # what a copy is made of
        self._native = native and is_native_available()
        self._checked, self._drawn = checked, 0
        self._preprocessing = find_preprocessing(preprocessing)
        self._fixtures = np.zeros(0)
        self._bodies = array("d", bytes(8 * 20))  # x, y, angle and phase of each wheel and the hull
        self._scratch = np.empty((96, 96, 3), np.uint8)
        self.observation_space = gymnasium.spaces.Box(0, 255, self._preprocessing.shape, np.uint8)

    @property
    def drawn_by(self) -> str:
        """Which one draws the observation: `native` or `gymnasium`."""
        return "native" if self._native else "gymnasium"

    @property
    def fuses_products(self) -> bool:
        """Whether Box2D was built with fused multiplications and additions, which move bodies to other bits."""
        return box2d_fuses_products()

    def step(self, action: Any) -> Any:
        """Gymnasium's step; `InvalidAction` for an action of another shape or with NaN, before anything moves."""
        if self._native and self.car.__class__ is car_dynamics.Car:  # a reset made a new car
            self.car.__class__ = Car
        if action is None or not self.continuous:
            return super().step(action)
        action = np.asarray(action)
        if action.shape != (3,) or not all(map(math.isfinite, action.tolist())):
            raise InvalidAction(f"an action is three finite numbers (steering, gas, brake), not {action!r}")
        return self._step(*map(float, action.tolist())) if self._native else super().step(action)

    def _step(self, steering: float, gas: float, brake: float) -> Any:
        """Gymnasium's step, its continuous case, with fewer calls."""
        car = self.car
        car.steer(-steering)
        car.gas(gas)
        car.brake(brake)
        car.step(1.0 / car_racing.FPS)
        self.world.Step(1.0 / car_racing.FPS, 6 * 30, 2 * 30)
        self.t += 1.0 / car_racing.FPS
        self.state = self._render("state_pixels")

        self.reward -= 0.1
        car.fuel_spent = 0.0
        step_reward = self.reward - self.prev_reward
        self.prev_reward = self.reward
        info = {}
        if self.tile_visited_count == len(self.track) or self.new_lap:
            info["lap_finished"] = True
        position = car.hull.position
        if abs(position.x) > car_racing.PLAYFIELD or abs(position.y) > car_racing.PLAYFIELD:
            info["lap_finished"] = False
            step_reward = -100
        if self.render_mode == "human":
            self.render()
        return self.state, step_reward, bool(info), False, info

    def _create_track(self) -> bool:
        """Make gymnasium's track; then keep the tiles' colours in one array, which contacts change in place."""
        if not super()._create_track():
            return False
        listener = self.world.contactListener_bug_workaround
        if self._native and listener.__class__ is car_racing.FrictionDetector:
            listener.__class__ = Listener
        self._drawn = 0
        self._road = np.array([corners for corners, _ in self.road_poly], dtype=np.float64)
        self._road_colours = np.array([colour for _, colour in self.road_poly], dtype=np.float64)
        rows = {id(colour): row for row, (_, colour) in enumerate(self.road_poly)}
        for tile in self.road:
            row = rows[id(tile.color)]
            tile.color = self._road_colours[row]
            self.road_poly[row] = (self.road_poly[row][0], tile.color)
        self._palette = np.array([self.bg_color, self.grass_color], dtype=np.float64)
        self._fixtures = np.zeros(0)
        return True

    def _render(self, mode: str) -> Any:
        if mode != "state_pixels":
            return super()._render(mode)
        if not self._native:
            return self._preprocessing.picture(super()._render(mode))
        picture = self._draw()
        if self._checked and self._drawn % self._checked == 0:
            self._compare(picture, self._preprocessing.picture(super()._render(mode)))
        self._drawn += 1
        return picture

    def _compare(self, ours: NDArray[np.uint8], theirs: NDArray[np.uint8]) -> None:
        if not np.array_equal(ours, theirs):
            pixels = plural(int((ours != theirs).any(axis=-1).sum()), "pixel")
            raise DreamfleetError(
                f"the native picture differs from gymnasium's by {pixels}, so its scores would be others: set "
                f"`{PICTURES}=gymnasium`, and gymnasium draws; please report this, with pygame's and gymnasium's "
                "version"
            )

    def _draw(self) -> NDArray[np.uint8]:
        """The picture `(size, size, 3)` of the preprocessing."""
        car, t, bodies = self.car, self.t, self._bodies
        if not self._fixtures.size:
            self._fixtures = list_fixtures(car)
        _native.look(bodies, car)
        zoom = 0.1 * car_racing.SCALE * max(1 - t, 0) + car_racing.ZOOM * car_racing.SCALE * min(t, 1)
        camera = array("d", (zoom, -bodies[18], bodies[16], bodies[17], car_racing.PLAYFIELD))
        small = self._preprocessing is BOX
        out = self._scratch if small else np.empty((96, 96, 3), np.uint8)
        _native.scene(out, self._road, self._road_colours, GRASS, self._palette, camera, bodies, self._fixtures, WHEEL)
        if small:
            picture = np.empty(BOX.shape, np.uint8)
            _native.picture(picture, out)
            return picture
        self._draw_bar(out[84:])
        return self._preprocessing.picture(out)

    def _draw_bar(self, rows: NDArray[np.uint8]) -> None:
        car, hull = self.car, self.car.hull
        velocity = hull.linearVelocity
        vx, vy = velocity.x, velocity.y
        wheels = car.wheels
        _native.bar(
            rows, math.sqrt(vx * vx + vy * vy), *(wheel.omega for wheel in wheels),
            wheels[0].joint.angle, hull.angularVelocity,
        )  # fmt: skip
        text = render_score(f"{self.reward:04.0f}")
        rows[:, : text.shape[1]] = text


def is_native_available() -> bool:
    """Whether the native module was built."""
    return _native is not None


def list_fixtures(car: car_dynamics.Car) -> NDArray[np.float64]:
    """The car's polygons in drawing order, flat: for each its body, colour, vertex count and vertices."""
    rows: list[float] = []
    for obj in car.drawlist:
        body = 4 if obj is car.hull else car.wheels.index(obj)
        for fixture in obj.fixtures:
            vertices = fixture.shape.vertices
            rows += [body, *(int(c * 255) for c in obj.color), len(vertices)]
            rows += [value for vertex in vertices for value in vertex]
    return np.array(rows, dtype=np.float64)


@lru_cache(maxsize=4096)
def render_score(text: str) -> NDArray[np.uint8]:
    """The score's text as pixels `(12, 12, 3)`: the observation's rows 84-95, columns 0-11.

    The text lies within the window's first 125 columns, which are exactly twelve of the observation's.
    """
    image = _render_text(text)
    place = image.get_rect()
    place.center = (60, int(car_racing.WINDOW_H - car_racing.WINDOW_H * 2.5 / 40.0))
    surface = pygame.Surface((TEXT_WIDTH, car_racing.WINDOW_H))
    surface.blit(image, place)
    small = pygame.transform.smoothscale(surface, (12, 96))
    return np.array(pygame.surfarray.pixels3d(small)[:, 84:].transpose(1, 0, 2), order="C")


def _render_text(text: str) -> pygame.Surface:
    try:
        return _font().render(text, True, (255, 255, 255), (0, 0, 0))
    except pygame.error:  # closing a window has shut down pygame and its fonts
        _font.cache_clear()
        return _font().render(text, True, (255, 255, 255), (0, 0, 0))


@cache
def _font() -> pygame.font.Font:
    pygame.font.init()
    return pygame.font.Font(pygame.font.get_default_font(), 42)


_SIDE = car_racing.GRASS_DIM
GRASS = np.array([
    [(_SIDE * x + _SIDE, _SIDE * y), (_SIDE * x, _SIDE * y),
     (_SIDE * x, _SIDE * y + _SIDE), (_SIDE * x + _SIDE, _SIDE * y + _SIDE)]
    for x in range(-20, 20, 2) for y in range(-20, 20, 2)
], dtype=np.float64)  # fmt: skip
WHEEL = np.array([car_dynamics.WHEEL_W, car_dynamics.WHEEL_R, car_dynamics.SIZE, *car_dynamics.WHEEL_WHITE], float)


@cache
def box2d_fuses_products() -> bool:
    """Whether a product of the installed Box2D keeps digits that a separate multiplication drops."""
    root, square = 1 + 2.0**-12, 1 + 2.0**-11  # the root's square is 2^-24 larger
    pairs = (((root, -1), (root, square)), ((-1, root), (square, root)))
    return any(b2Vec2(*first).dot(b2Vec2(*second)) != 0 for first, second in pairs)
