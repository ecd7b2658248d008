"""Pillow's bilinear resize of 8-bit pictures without Pillow: the same bits, on every host."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
TAP_BITS = 22  # of the fraction in Pillow's weights for 8-bit pictures


def shrink(picture: Pixels, size: int) -> Pixels:
    """A picture `(H, W, 3)` of at least `size` pixels a side as `(size, size, 3)`."""
    height, width, _ = picture.shape
    columns = picture.transpose(1, 0, 2).reshape(width, height * 3)  # Pillow's horizontal pass is its first
    narrow = _shrink_rows(columns, size).reshape(size, height, 3).transpose(1, 0, 2)
    return _shrink_rows(narrow.reshape(height, size * 3), size).reshape(size, size, 3)


def _shrink_rows(values: Pixels, size: int) -> Pixels:
    """Rows `(n, m)` as `(size, m)`."""
    shrunk = np.empty((size, values.shape[1]), np.uint8)
    for row, (first, weights) in enumerate(_taps(len(values), size)):
        # Every sum is an integer below 2**53, so float64 is exact and BLAS may add in any order.
        sums = weights @ values[first : first + len(weights)].astype(np.float64)
        shrunk[row] = np.floor((sums + 2 ** (TAP_BITS - 1)) / 2**TAP_BITS)
    return shrunk


@lru_cache(maxsize=8)
def _taps(length: int, size: int) -> list[tuple[int, NDArray[np.float64]]]:
    """The first old row that counts in each new one, and the weights from there on, whole numbers of `2**-TAP_BITS`.

    A triangle as wide as the step between new rows reaches to each side of a new row's middle.
    """
    step, taps = length / size, []
    for row in range(size):
        middle = (row + 0.5) * step
        first, last = max(int(middle - step + 0.5), 0), min(int(middle + step + 0.5), length)
        heights = [max(0.0, 1 - abs((source - middle + 0.5) / step)) for source in range(first, last)]
        weights = [int(height / sum(heights) * 2**TAP_BITS + 0.5) for height in heights]
        taps.append((first, np.array(weights, np.float64)))
    return taps
