"""What is seen of Take Cover: a cropped and resized picture, or a few numbers for controllers without a world model."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dreamfleet.worker.tasks.api import Preprocessing
from dreamfleet.worker.tasks.pictures import box_resize
from dreamfleet.worker.worlds.takecover.game import WIDTH
from dreamfleet.worker.worlds.takecover.options import TakeCoverOptions

SIZES = (64, 96)
FIRST_ROW, ROWS, COLUMNS = 48, 4, 32  # of the band: its first row in the picture, and its numbers
CELL = (6, WIDTH // COLUMNS)  # rows and columns of the picture for each of its numbers
BAND = ROWS * COLUMNS
Pixels = NDArray[np.uint8]
Floats = NDArray[np.float32]


def make_preprocessings(options: TakeCoverOptions) -> dict[str, Preprocessing]:
    """The preprocessings of the options' crop by name, the usual one first.

    >>> [each.shape for each in make_preprocessings(TakeCoverOptions()).values()]
    [(64, 64, 3), (96, 96, 3)]
    """
    crop = "" if options.crop == TakeCoverOptions.crop else f" of {options.crop}"
    return {f"box-{size}{crop}": _make_preprocessing(f"box-{size}{crop}", size, options) for size in SIZES}


def _make_preprocessing(name: str, size: int, options: TakeCoverOptions) -> Preprocessing:
    top, bottom, left, right = options.part
    return Preprocessing(name, size, lambda picture: box_resize(picture[top:bottom, left:right], size))


def observe_band(picture: Pixels) -> Floats:
    """Brightness from 0 to 1 in 4 x 32 cells of the rows at the height of the eyes, `(128,)`.

    >>> observe_band(np.full((120, 160, 3), 255, np.uint8)).tolist() == [1.0] * 128
    True
    """
    height, width = CELL
    band = picture[FIRST_ROW : FIRST_ROW + ROWS * height].reshape(ROWS, height, COLUMNS, width, 3)
    # Whole numbers, so that every host has the same bits.
    sums = band.sum(axis=(1, 3, 4), dtype=np.int64).reshape(-1)
    brightness: Floats = (sums / (255 * 3 * height * width)).astype(np.float32)
    return brightness


class ObserveBand(gymnasium.ObservationWrapper[Floats, Any, Pixels]):
    """Take Cover that observes its band."""

    def __init__(self, environment: gymnasium.Env[Any, Any]) -> None:
        super().__init__(environment)
        self.observation_space = spaces.Box(0, 1, (BAND,), np.float32)

    def observation(self, observation: Pixels) -> Floats:
        """The band's numbers `(128,)`."""
        return observe_band(observation)
