"""The environments that a person drives in, and how they are drawn."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np
import pygame

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.dream.environment import Dream
from dreamfleet.worker.tasks.registry import find_task

WIDTH = 640  # pixels of a dream's picture on a screen


class Scene(Protocol):
    """An environment that takes steering, gas and brake, with its picture."""

    name: str
    scale: float  # from the picture to a suitable size on a screen
    environment: gymnasium.Env[Any, Any]

    def surface(self) -> pygame.Surface:
        """The current picture."""


@runtime_checkable
class TaskWithScene(Protocol):
    """Optional: a task in whose world a person drives, by steering, gas and brake.

    >>> isinstance(find_task("car-racing"), TaskWithScene)
    True
    """

    def make_scene(self, steps: int) -> Scene:
        """A new scene, which ends after so many steps at most."""


def make_scene(task: str, steps: int) -> Scene:
    """The scene of a task's world; `UsageError` if nobody drives in it by hand."""
    found = find_task(task)
    if not isinstance(found, TaskWithScene):
        raise UsageError(f"task {task} has no driving by hand")
    return found.make_scene(steps)


class DreamScene:
    """A bundle's dream, decoded."""

    name = "a dream"

    def __init__(self, bundle: Bundle, temperature: float, steps: int) -> None:
        self.scale = WIDTH / bundle.manifest.picture[1]
        self.environment: gymnasium.Env[Any, Any] = Dream(bundle, temperature, steps, "rgb_array")

    def surface(self) -> pygame.Surface:
        """The decoded latent."""
        picture: Any = self.environment.render()
        return pygame.surfarray.make_surface(np.transpose(picture, (1, 0, 2)))
