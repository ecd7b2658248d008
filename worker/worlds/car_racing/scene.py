"""CarRacing on a screen, for a person who drives."""

from __future__ import annotations

from typing import Any

import pygame

from dreamfleet.worker.worlds.car_racing.native_check import make_car_racing
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX


class CarRacingScene:
    """CarRacing, drawn by gymnasium at its full size of 1000x800."""

    name, scale = "CarRacing", 1.0

    def __init__(self, steps: int) -> None:
        self.environment = make_car_racing(preprocessing=BOX.name, render_mode="rgb_array", max_episode_steps=steps)

    def surface(self) -> pygame.Surface:
        """Gymnasium's own surface; `render` returns a smaller copy."""
        self.environment.render()
        inner: Any = self.environment.unwrapped
        drawn: pygame.Surface = inner.surf
        return drawn
