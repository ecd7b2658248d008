"""The environments that a person drives in, and how they are drawn."""

from __future__ import annotations

from typing import Any, Protocol

import gymnasium
import numpy as np
import pygame

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.worker.car_racing.native_check import make_car_racing
from dreamfleet.worker.car_racing.preprocessing import BOX
from dreamfleet.worker.dream.environment import CarRacingDream

WIDTH = 640  # pixels of a dream's picture on a screen


class Scene(Protocol):
    """An environment that takes CarRacing's actions, with its picture."""

    name: str
    scale: float  # from the picture to a suitable size on a screen
    environment: gymnasium.Env[Any, Any]

    def surface(self) -> pygame.Surface:
        """The current picture."""


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


class DreamScene:
    """A bundle's dream, decoded."""

    name = "a dream"

    def __init__(self, bundle: Bundle, temperature: float, steps: int) -> None:
        self.scale = WIDTH / bundle.manifest.picture[1]
        self.environment: gymnasium.Env[Any, Any] = CarRacingDream(bundle, temperature, steps, "rgb_array")

    def surface(self) -> pygame.Surface:
        """The decoded latent."""
        picture: Any = self.environment.render()
        return pygame.surfarray.make_surface(np.transpose(picture, (1, 0, 2)))
