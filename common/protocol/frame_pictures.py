"""Pictures of live frames: shrunk and packed for sending, checked when unpacked."""

import zlib

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.protocol.messages import MAX_PICTURE_SIDE, ViewFrame
from dreamfleet.common.schema.validation import MalformedError

MAX_PACKED = 32 * 1024  # bytes; leaves room for the rest of a frame
ZLIB_LEVEL = 1  # shrinks a 64x64 picture to a quarter in 0.1 ms
Picture = NDArray[np.uint8]


def pack_picture(picture: Picture) -> tuple[int, int, bytes]:
    """Height, width and deflated bytes of a picture `(height, width, 3)`, downsampled by a whole factor to fit."""
    factor = -(-max(picture.shape[:2]) // MAX_PICTURE_SIDE)
    while True:
        small = _downsample(picture, factor) if factor > 1 else picture
        data = zlib.compress(small.tobytes(), ZLIB_LEVEL)
        if len(data) <= MAX_PACKED:
            return small.shape[0], small.shape[1], data
        factor += 1


def unpack_picture(frame: ViewFrame) -> Picture | None:
    """The picture `(height, width, 3)` of a frame, `None` without one; `MalformedError` if its length is wrong."""
    if not frame.picture:
        return None
    size = frame.height * frame.width * 3
    data = _inflate(frame.picture, size) if frame.packed else frame.picture
    if len(data) != size:
        raise MalformedError("wrong length")
    return np.frombuffer(data, np.uint8).reshape(frame.height, frame.width, 3)


def _downsample(picture: Picture, factor: int) -> Picture:
    """Average blocks of `factor x factor` pixels; a side that is no multiple loses its last pixels."""
    height, width = (max(1, side // factor) for side in picture.shape[:2])
    rows, columns = min(factor, picture.shape[0]), min(factor, picture.shape[1])
    total = np.zeros((height, width, 3), np.uint32)
    for row in range(rows):
        for column in range(columns):
            total += picture[row : height * rows : rows, column : width * columns : columns]
    mean: Picture = (total // (rows * columns)).astype(np.uint8)
    return mean


def _inflate(data: bytes, max_bytes: int) -> bytes:
    """Inflate to at most `max_bytes + 1` bytes, so that a zip bomb is harmless and too long data shows."""
    try:
        return zlib.decompressobj().decompress(data, max_bytes + 1)
    except zlib.error as error:
        raise MalformedError("not deflated") from error
