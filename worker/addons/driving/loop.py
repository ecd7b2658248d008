"""Driving by hand: the environments, how they are drawn, and the loop that steps one with the keys of a window."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np
import pygame

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.driving.drive_window import DriveWindow
from dreamfleet.worker.dream.environment import Dream
from dreamfleet.worker.tasks.closing import closing_environment
from dreamfleet.worker.tasks.registry import find_task

WIDTH = 640  # pixels of a dream's picture on a screen; the help of `--scale` says it


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


@dataclass(frozen=True)
class DrivingConfig:
    """Seed, most steps of an episode, and scale of the picture (`None`: the scene's own)."""

    seed: int
    steps: int = 1000
    scale: float | None = None

    def __post_init__(self) -> None:
        if self.seed < 0 or self.steps < 1:
            raise UsageError("--steps must be at least 1 and --seed at least 0")
        if self.scale is not None and not 0 < self.scale <= 100:
            raise UsageError(f"--scale must be above 0 and at most 100, not {self.scale}")


@dataclass(frozen=True)
class DriveResult:
    """Score and number of steps of an episode."""

    score: float
    steps: int


def drive(
    scene: Scene, config: DrivingConfig, on_frame: Callable[[int], None] = lambda _step: None
) -> Iterator[DriveResult]:
    """Drive until the person quits; yield each episode when it is over or left.

    `on_frame` gets the step of each frame.
    """
    environment = scene.environment
    environment.reset(seed=config.seed)
    picture, score, step, over = scene.surface(), 0.0, 0, False
    window = DriveWindow(scene.name, picture.get_size(), config.scale or scene.scale)
    with closing_environment(environment), window:
        while True:
            for command in window.read_commands():
                if not over:
                    yield DriveResult(score, step)
                if command == "quit":
                    return
                environment.reset(seed=config.seed)
                score, step, over = 0.0, 0, False
            if not over:
                _, reward, terminated, truncated, _ = environment.step(window.pedals.action())
                score, step, over = score + float(reward), step + 1, terminated or truncated
                picture = scene.surface()
                if over:
                    yield DriveResult(score, step)
            window.show(picture, score, step, config.steps, over=over)
            on_frame(step)
