"""One recorded episode of a data set: the observation before each action, the action, and its reward."""

from __future__ import annotations

import io
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray


class Rollout:
    """A recording that grows step by step; equal recordings give equal files."""

    def __init__(self, driver: str, preprocessing: str) -> None:
        self.ended = False  # whether the environment ended it
        self._driver = driver
        self._preprocessing = preprocessing
        self._pictures: list[NDArray[np.uint8]] = []
        self._actions: list[NDArray[np.float32]] = []
        self._rewards: list[float] = []

    def __len__(self) -> int:
        return len(self._actions)

    def add(self, picture: Any, action: Any, reward: float) -> None:
        """Add a step: the picture before the action, the action, and its reward."""
        self._pictures.append(picture)
        self._actions.append(action)
        self._rewards.append(reward)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The T steps as arrays: `picture` (T, side, side, 3), `action` (T, actions), `reward` (T,), and metadata."""
        return {
            "picture": np.stack(self._pictures),
            "action": np.stack(self._actions),
            "reward": np.array(self._rewards, dtype=np.float32),
            "ended": np.array(self.ended),
            "driver": np.array(self._driver),
            "preprocessing": np.array(self._preprocessing),
        }

    def to_bytes(self) -> bytes:
        """The recording as a compressed `.npz` file."""
        file = io.BytesIO()
        write_episode(file, self.arrays())
        return file.getvalue()


def write_episode(file: BinaryIO, arrays: dict[str, NDArray[Any]]) -> None:
    """Write an episode's arrays as a compressed `.npz`."""
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
