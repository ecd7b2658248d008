"""From CarRacing's 96x96 observation to the picture that a world model sees.

`raw-96` is the whole observation. `box-64` is its rows 0-83 (below them is the indicator bar) after an exact integer
box filter 84x96 -> 64x64: an output pixel averages 21/16 rows and 3/2 columns. With weights in sixteenths and halves
their sum is 63 and the pixel `(sum + 31) // 63`. It uses no library's resize, so that the native renderer can equal it
to the bit. `whole-64` is the whole observation, bar included, as Pillow's bilinear resize shrinks it: the pictures of
ctallec/world-models.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.worlds.bilinear import shrink

Pixels = NDArray[np.uint8]
SCENE_ROWS = 84
SMALL = 64


def _row_weights() -> NDArray[np.float32]:
    """`(64, 84)`: how many sixteenths of each source row lie in each output row."""
    edges = np.arange(SMALL + 1) * 21
    sources = np.arange(SCENE_ROWS) * 16
    overlap = np.minimum(edges[1:, None], sources + 16) - np.maximum(edges[:-1, None], sources)
    return np.asarray(np.clip(overlap, 0, 16), dtype=np.float32)


_ROWS = _row_weights()


def _box(observation: Pixels) -> Pixels:  # native/box.c and standalone_drive.py compute the same
    scene = observation[:SCENE_ROWS].reshape(SCENE_ROWS, 96 * 3).astype(np.float32)
    # Every sum is an integer below 2**24, so float32 is exact and BLAS may add in any order.
    rows = (_ROWS @ scene).reshape(SMALL, 32, 3, 3)
    middle = rows[:, :, 1]
    sums = np.empty((SMALL, 32, 2, 3), dtype=np.uint16)
    sums[:, :, 0] = 2 * rows[:, :, 0] + middle
    sums[:, :, 1] = 2 * rows[:, :, 2] + middle
    return ((sums + 31) // 63).astype(np.uint8).reshape(SMALL, SMALL, 3)


def _whole(observation: Pixels) -> Pixels:
    return shrink(observation, SMALL)


def _raw(observation: Pixels) -> Pixels:
    return observation


BOX = Preprocessing("box-64", SMALL, _box)
RAW = Preprocessing("raw-96", 96, _raw, mirrors=False)  # a mirrored indicator bar never occurs
WHOLE = Preprocessing("whole-64", SMALL, _whole, mirrors=False)  # named in worker/addons/importing/
PREPROCESSINGS = {each.name: each for each in (BOX, RAW, WHOLE)}  # new data have the first one of their size


def find_preprocessing(name: str) -> Preprocessing:
    """The preprocessing of that name; `UsageError` lists those that exist."""
    if name not in PREPROCESSINGS:
        raise UsageError(f"unknown preprocessing {name!r}: choose one of {', '.join(PREPROCESSINGS)}")
    return PREPROCESSINGS[name]
