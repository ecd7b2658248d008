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

Pixels = NDArray[np.uint8]
SCENE_ROWS = 84
SMALL = 64
TAP_BITS = 22  # of the fraction in Pillow's weights for 8-bit pictures


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


def _pillow_taps(size: int, small: int) -> NDArray[np.float64]:
    """`(small, size)`: the weights of Pillow's bilinear filter, as whole numbers of `2**-TAP_BITS`.

    A triangle as wide as the step between output pixels reaches to each side of an output pixel's middle.
    """
    step = size / small
    taps = np.zeros((small, size))
    for pixel in range(small):
        middle = (pixel + 0.5) * step
        first, last = max(int(middle - step + 0.5), 0), min(int(middle + step + 0.5), size)
        weights = [max(0.0, 1 - abs((source - middle + 0.5) / step)) for source in range(first, last)]
        total = sum(weights)
        taps[pixel, first:last] = [int(weight / total * 2**TAP_BITS + 0.5) for weight in weights]
    return taps


_TAPS = _pillow_taps(96, SMALL)


def _shrink_rows(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shrink the first axis of `(96, n)` to 64 rows of whole numbers, rounded."""
    # Every sum is an integer below 2**53, so float64 is exact and BLAS may add in any order.
    rounded: NDArray[np.float64] = np.floor((_TAPS @ pixels + 2 ** (TAP_BITS - 1)) / 2**TAP_BITS)
    return rounded


def _whole(observation: Pixels) -> Pixels:
    columns = observation.transpose(1, 0, 2).reshape(96, 96 * 3).astype(np.float64)
    narrow = _shrink_rows(columns).reshape(SMALL, 96, 3).transpose(1, 0, 2)  # Pillow's horizontal pass is its first
    return _shrink_rows(narrow.reshape(96, SMALL * 3)).astype(np.uint8).reshape(SMALL, SMALL, 3)


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
