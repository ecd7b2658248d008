"""gymnasium's own CarRacing: it drives where nothing native was built, and beside ours it judges and draws for people.

Importing this needs Box2D and pygame.
"""

from __future__ import annotations

import copy
from functools import cache
from typing import Any

import numpy as np
from Box2D import b2Vec2
from gymnasium import spaces
from gymnasium.envs.box2d import car_racing
from gymnasium.envs.box2d.car_dynamics import Car
from gymnasium.utils import EzPickle

from dreamfleet.worker.worlds.car_racing.environment import CarRacing, controls
from dreamfleet.worker.worlds.car_racing.preprocessing import RAW, find_preprocessing

_Base: Any = car_racing.CarRacing  # untyped upstream


class _Placeable(_Base):  # type: ignore[misc]
    car: Any
    reward: float

    def place(self, angle: float, x: float, y: float) -> None:
        """A new car at a place."""
        self.car.destroy()
        self.car = Car(self.world, angle, x, y)  # type: ignore[no-untyped-call]


class GymnasiumCarRacing(_Placeable):
    """gymnasium's CarRacing-v3 with the pictures of a preprocessing; it refuses what is no action."""

    drawn_by = "gymnasium"

    def __init__(self, *arguments: Any, preprocessing: str = RAW.name, **more: Any) -> None:
        super().__init__(*arguments, **more)
        EzPickle.__init__(self, *arguments, preprocessing=preprocessing, **more)  # what a copy is made of
        self._preprocessing = find_preprocessing(preprocessing)
        self.observation_space = spaces.Box(0, 255, self._preprocessing.shape, np.uint8)

    @property
    def fuses_products(self) -> bool:
        """Whether Box2D was built with fused multiplications and additions, which move bodies to other bits."""
        return box2d_fuses_products()

    def step(self, action: Any) -> Any:
        """Gymnasium's step; `InvalidAction` for an action of another shape or with NaN, before anything moves."""
        if action is not None and self.continuous:
            action = np.asarray(action)
            controls(action)
        return super().step(action)

    def _render(self, mode: str) -> Any:
        drawn = super()._render(mode)
        return self._preprocessing.picture(drawn) if mode == "state_pixels" else drawn


class Shadow(_Placeable):
    """gymnasium's CarRacing that does all that one of ours does, and draws no observation unless asked."""

    _shown = 0.0

    def begin(self, ours: CarRacing, options: Any) -> None:
        """Begin the episode that ours is about to begin."""
        self.np_random = copy.deepcopy(ours.np_random)
        self.road_color, self.bg_color, self.grass_color = (each.copy() for each in ours.colours)
        self.reset(options=options)

    def observe(self) -> Any:
        """The observation that the last step or reset would have given."""
        after, self.reward = self.reward, self._shown
        observation = super()._render("state_pixels")
        self.reward = after
        return observation

    def _render(self, mode: str) -> Any:
        if mode != "state_pixels":
            return super()._render(mode)
        self._shown = self.reward  # the time of this step is paid afterwards
        return None


@cache
def box2d_fuses_products() -> bool:
    """Whether a product of the installed Box2D keeps digits that a separate multiplication drops."""
    root, square = 1 + 2.0**-12, 1 + 2.0**-11  # the root's square is 2^-24 larger
    pairs = (((root, -1), (root, square)), ((-1, root), (square, root)))
    return any(b2Vec2(*first).dot(b2Vec2(*second)) != 0 for first, second in pairs)
