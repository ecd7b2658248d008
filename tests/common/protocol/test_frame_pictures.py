import tracemalloc
import zlib

import numpy as np
import pytest

from dreamfleet.common.protocol.frame_pictures import pack_picture, unpack_picture
from dreamfleet.common.protocol.messages import MAX_PART, MAX_PICTURE_SIDE, ViewFrame
from dreamfleet.common.schema.validation import MalformedError
from tests.support.samples import HEAD


def frame(height, width, picture, packed=True):
    return ViewFrame(**HEAD, slot=0, tag=b"ABCDEFGH", step=0, reward=0.0, height=height, width=width, picture=picture,
                     packed=packed)  # fmt: skip


def random(*shape):
    return np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)


def test_a_small_picture_round_trips_and_none_is_none():
    for side in (64, 96):
        picture = random(side, side)
        assert (unpack_picture(frame(*pack_picture(picture))) == picture).all()
    assert unpack_picture(frame(1, 1, b"", packed=False)) is None


def test_a_large_picture_is_averaged():
    picture = np.zeros((400, 600, 3), np.uint8)
    picture[:, ::3] = 90
    height, width, data = pack_picture(picture)
    assert (height, width) == (133, 200)
    assert (unpack_picture(frame(height, width, data)) == 30).all()


@pytest.mark.parametrize("shape", [(2000, 3000), (1, 5000), (5000, 1), (257, 257)])
def test_every_picture_fits(shape):
    height, width, data = pack_picture(random(*shape))
    assert max(height, width) <= MAX_PICTURE_SIDE
    assert len(data) <= MAX_PART
    assert unpack_picture(frame(height, width, data)).shape == (height, width, 3)


def test_invalid_picture_bytes_are_malformed():
    sizes = (zlib.compress(bytes(count)) for count in (13, 11))
    for sent in (frame(2, 2, b"x", packed=False), *(frame(2, 2, data) for data in (b"not deflated", *sizes))):
        with pytest.raises(MalformedError):
            unpack_picture(sent)


def test_a_zip_bomb_takes_no_more_memory_than_its_declared_picture():
    bomb = zlib.compress(bytes(30 << 20), 9)
    tracemalloc.start()
    with pytest.raises(MalformedError):
        unpack_picture(frame(MAX_PICTURE_SIDE, MAX_PICTURE_SIDE, bomb))
    assert tracemalloc.get_traced_memory()[1] < 3 * MAX_PICTURE_SIDE**2 * 3
    tracemalloc.stop()
