"""One recorded episode of a data set: the observation before each action, the action, and its reward."""

from __future__ import annotations

import io
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.driving import FIRST_WORLD


class DataWorld(NamedTuple):
    """The world of data: a task's name, and the options under which it was recorded."""

    task: str
    options: str = ""  # as the task's `parse_options` writes them

    @property
    def text(self) -> str:
        """The text that stands in a file."""
        return f"{self.task}\n{self.options}"

    @classmethod
    def of(cls, bundle: Bundle) -> DataWorld:
        """The world of the data that a bundle was trained on."""
        return cls(bundle.manifest.task, bundle.manifest.world.options)

    @classmethod
    def parse(cls, text: str) -> DataWorld:
        """The world of a file's text."""
        task, _, options = text.partition("\n")
        return cls(task, options)

    def __str__(self) -> str:
        return f"{self.task} with {self.options}" if self.options else self.task


OF_FIRST_WORLD = DataWorld(FIRST_WORLD)


class Rollout:
    """A recording that grows step by step; equal recordings give equal files."""

    def __init__(self, driver: str, preprocessing: str, world: DataWorld) -> None:
        self.ended = False  # whether the environment ended it
        self.terminal = False  # whether that was a death, and no limit
        self._driver = driver
        self._preprocessing = preprocessing
        self._world = world
        self._pictures: list[NDArray[np.uint8]] = []
        self._actions: list[NDArray[np.float32]] = []
        self._rewards: list[float] = []

    def __len__(self) -> int:
        return len(self._actions)

    def add(self, picture: Any, action: Any, reward: float) -> None:
        """Add a step: the picture before the action, the action, and its reward.

        So the picture after the last action is never recorded; in some worlds it is black.
        """
        self._pictures.append(picture)
        self._actions.append(action)
        self._rewards.append(reward)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The T steps as arrays: `picture` (T, side, side, 3), `action` (T, actions), `reward` (T,), and metadata.

        `terminal` is there only where it differs from `ended`.
        """
        arrays: dict[str, NDArray[Any]] = {  # docs/reference/files.md
            "picture": np.stack(self._pictures),
            "action": np.stack(self._actions),
            "reward": np.array(self._rewards, dtype=np.float32),
            "ended": np.array(self.ended),
            "driver": np.array(self._driver),
            "preprocessing": np.array(self._preprocessing),
            "world": np.array(self._world.text),
        }
        if self.terminal != self.ended:
            arrays["terminal"] = np.array(self.terminal)
        return arrays

    def to_bytes(self) -> bytes:
        """The recording as a compressed `.npz` file."""
        file = io.BytesIO()
        write_episode(file, self.arrays())
        return file.getvalue()


def write_episode(file: BinaryIO, arrays: dict[str, NDArray[Any]]) -> None:
    """Write an episode's arrays as a compressed `.npz`."""
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
