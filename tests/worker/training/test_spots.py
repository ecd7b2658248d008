"""Spots of synthetic pictures, whose number, size, place and loss are known. Tests spots.py."""

import tracemalloc

import numpy as np
import pytest

from dreamfleet.worker.training.spots import find_spots, kept_shares, measure_mean

MEAN = np.full((64, 64, 3), 40.0)


def picture(*parts):
    made = np.full((64, 64, 3), 40, np.uint8)
    for rows, columns in parts:
        made[rows, columns] = 240
    return made


SMALL, SNAKE, LARGE = (np.s_[10:13], np.s_[4:7]), (np.s_[30], np.s_[2:60]), (np.s_[40:60], np.s_[20:50])


def test_each_connected_part_is_one_spot_with_its_size_and_place():
    pictures = np.stack([picture(SMALL, LARGE), picture(SNAKE, (np.s_[31:39], np.s_[59]))])
    spots = find_spots(pictures, pictures, MEAN, 10.0)
    assert sorted(spots.size.tolist()) == [9, 66, 600]
    assert spots.kept.all()
    (small,) = np.flatnonzero(spots.size == 9)
    assert (spots.row[small], spots.column[small]) == (11.5 / 64, 5.5 / 64)


def test_a_spot_that_is_faint_or_elsewhere_in_the_reconstruction_is_lost():
    pictures, away = picture(SMALL, LARGE)[None], (np.s_[10:13], np.s_[9:12])
    faint = ((pictures - MEAN) * 0.4 + MEAN)[0]
    for shown, kept in ((picture(LARGE), 0.0), (picture(away, LARGE), 0.0), (faint, 0.0), (pictures[0], 1.0)):
        spots = find_spots(pictures, shown[None], MEAN, 10.0)
        assert kept_shares(spots) == {"kept_of_spots_5_to_16": kept}


def test_many_pictures_have_the_spots_of_each_and_take_the_memory_of_a_batch():
    rng = np.random.default_rng(2)
    pictures = rng.integers(0, 255, (350, 24, 24, 3), dtype=np.uint8)
    shown, mean = pictures.astype(np.float32) * 0.9, MEAN[:24, :24]
    each = [find_spots(pictures[[index]], shown[[index]], mean, 20.0) for index in range(len(pictures))]

    def most(count):
        tracemalloc.start()
        found = find_spots(pictures[:count], shown[:count], mean, 20.0)
        spread = measure_mean(pictures[:count])[1]
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak, found, spread

    few, _, _ = most(100)
    many, found, spread = most(350)
    assert many < 2 * few
    assert all(
        np.array_equal(*parts) for parts in zip(found, map(np.concatenate, zip(*each, strict=True)), strict=True)
    )
    assert spread == pytest.approx(np.abs(pictures - pictures.mean(axis=0)).mean())


def test_pictures_like_the_mean_have_none():
    same = picture()[None]
    assert kept_shares(find_spots(same, same, MEAN, 1.0)) == {}
