"""Driving by hand: the loop that steps an environment with the keys of a window."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.driving.drive_window import DriveStatus, DriveWindow
from dreamfleet.worker.addons.driving.scene import Scene
from dreamfleet.worker.tasks.closing import close_environment


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
    picture = scene.surface()
    score, step, over = 0.0, 0, False
    with DriveWindow(scene.name, picture.get_size(), config.scale or scene.scale) as window:
        while True:
            for command in window.read_commands():
                if not over:
                    yield DriveResult(score, step)
                if command == "quit":
                    close_environment(environment)
                    return
                environment.reset(seed=config.seed)
                score, step, over = 0.0, 0, False
            if not over:
                _, reward, terminated, truncated, _ = environment.step(window.pedals.action())
                score, step, over = score + float(reward), step + 1, terminated or truncated
                picture = scene.surface()
                if over:
                    yield DriveResult(score, step)
            window.show(picture, DriveStatus(score, step, config.steps, over))
            on_frame(step)


def random_seed() -> int:
    """A random seed."""
    return int(np.random.default_rng().integers(10_000))
