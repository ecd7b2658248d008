import numpy as np
import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.tasks.pictures import box_resize
from dreamfleet.worker.training.data.dataset import preprocessing_of_size
from dreamfleet.worker.worlds.car_racing.environment import CarRacing
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX, RAW, WHOLE, find_preprocessing


@pytest.mark.parametrize("seed", range(5))
def test_the_picture_is_the_exact_integer_box_filter_and_the_raw_one_is_whole(seed):
    observation = np.random.default_rng(seed).integers(0, 256, (96, 96, 3), dtype=np.uint8)
    assert np.array_equal(BOX.picture(observation), box_resize(observation[:84], 64))
    assert np.array_equal(RAW.picture(observation), observation)


def test_a_preprocessing_is_found_by_name_and_by_size():
    for each in (BOX, RAW):
        assert find_preprocessing(each.name) is preprocessing_of_size(each.size) is each
        assert each.picture(np.zeros((96, 96, 3), np.uint8)).shape == each.shape
    with pytest.raises(UsageError, match=r"'bilinear-64'.*box-64, raw-96"):
        find_preprocessing("bilinear-64")
    with pytest.raises(UsageError, match="32"):
        preprocessing_of_size(32)


@pytest.mark.parametrize("levels", [256, 2])
def test_the_whole_picture_is_pillows_to_the_bit(levels):
    image = pytest.importorskip("PIL.Image")
    random = np.random.default_rng(levels)
    for _ in range(20):
        observation = (random.integers(0, levels, (96, 96, 3)) * (255 // (levels - 1))).astype(np.uint8)
        wanted = image.fromarray(observation).resize((64, 64), image.Resampling.BILINEAR)
        assert np.array_equal(WHOLE.picture(observation), np.asarray(wanted))


def test_the_environment_draws_the_whole_picture():
    raw, whole = (CarRacing(preprocessing=each.name).reset(seed=3)[0] for each in (RAW, WHOLE))
    assert np.array_equal(WHOLE.picture(raw), whole)
