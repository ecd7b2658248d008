import numpy as np
import pytest

from dreamfleet.worker.worlds.bilinear import shrink


@pytest.mark.parametrize(("shape", "size"), [((480, 640), 96), ((96, 96), 64), ((50, 41), 41), ((64, 64), 64)])
def test_equal_to_pillows_to_the_bit(shape, size):
    image = pytest.importorskip("PIL.Image")
    random = np.random.default_rng(1)
    for picture in (*random.integers(0, 256, (3, *shape, 3), dtype=np.uint8), np.full((*shape, 3), 255, np.uint8)):
        wanted = np.asarray(image.fromarray(picture).resize((size, size), image.Resampling.BILINEAR))
        assert np.array_equal(shrink(picture, size), wanted)
