"""Tests parallel_dream.py."""

from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE, Continuous, Discrete, one_hot
from dreamfleet.common.errors import UsageError
from dreamfleet.common.worlds.score_words import profile_of
from dreamfleet.worker.addons.recording.canvas import (
    BACKGROUND,
    DREAMING,
    LABEL,
    MARGIN,
    SIDE,
    Canvas,
    DriveFrame,
    ModelPictures,
    choice_name,
    plain_layout,
)
from dreamfleet.worker.addons.recording.parallel_dream import ParallelDream, ParallelDreamConfig
from dreamfleet.worker.worldmodel.inference import DreamStep

SEED, WORLD = 10_003, profile_of("car-racing")
RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
ACTION = np.array([0.0, 0.5, 1.0], np.float32)


def plain(colour):
    return np.full((64, 64, 3), colour, np.uint8)


MODELS = ModelPictures(plain(GREEN), plain(BLUE), plain(WHITE), 0)


def test_a_frame_shows_the_track_the_observation_and_the_decoded_latent():
    green = plain(GREEN)
    green[:, ::2] = 0  # an edge a pixel: enlarging must not blur it
    frame = Canvas(SEED, WORLD).draw(DriveFrame(plain(RED), ACTION, 7, 12.5, replace(MODELS, seen=green)))
    width, height = DREAMING.track
    column = slice(width + 20, width + 20 + SIDE)
    assert frame.shape[1::-1] == DREAMING.size
    assert (frame[height // 2, width // 2] == RED).all()
    assert {tuple(pixel) for pixel in frame[MARGIN + LABEL + SIDE // 2, column].tolist()} == {GREEN, (0, 0, 0)}
    assert (frame[400, column] == BLUE).all()
    assert not (frame[height + 20 :, :240] == BACKGROUND).all(), "score, step and track are written there"


def test_the_end_stands_on_the_top_of_the_worlds_picture_and_leaves_the_rest():
    moment = DriveFrame(plain(RED), ACTION, 7, 12.5, MODELS)
    before, after = (Canvas(SEED, WORLD).draw(replace(moment, end=end)) for end in ("", "lap finished"))
    rows = np.flatnonzero((before != after).any(axis=(1, 2)))
    columns = np.flatnonzero((before != after).any(axis=(0, 2)))
    assert MARGIN <= rows[0] <= rows[-1] < MARGIN + DREAMING.track[1] / 6
    assert MARGIN <= columns[0] <= columns[-1] < MARGIN + DREAMING.track[0]


@pytest.mark.parametrize("since", [0, 9900])
def test_a_dreamt_picture_and_its_label_fit_into_the_frame(since):
    models = replace(MODELS, since=since)
    frame = Canvas(SEED, WORLD).draw(DriveFrame(plain(RED), ACTION, 7, 12.5, models))
    assert frame.shape[1::-1] == DREAMING.size
    column = frame[:, DREAMING.track[0] + 20 :][:, :SIDE]
    heights = [int((column == colour).all(axis=(1, 2)).sum()) for colour in (GREEN, BLUE, WHITE)]
    assert heights == [SIDE] * 3
    assert (frame[:, -MARGIN // 2 :] == BACKGROUND).all(), "a label runs out of the frame"
    assert (frame[-MARGIN:] == BACKGROUND).all()


def span(low, high):
    return Continuous.between([low], [high])


@pytest.mark.parametrize(
    ("actions", "action", "filled"),
    [
        (span(-1, 1), [0.5], range(53, 79)), (span(-1, 1), [-1], range(53)), (span(-2, 2), [1.0], range(53, 79)),
        (span(0, 1), [0.5], range(53)), (span(0, 4), [1.0], range(26)), (span(1, 3), [2.0], range(53)),
        (span(0, 1), [9.0], range(106)), (span(-0.5, 2), [2], range(53, 106)),
        (STEERING_GAS_BRAKE, [0.5, 0.5, 0.0], range(53, 79)),
    ],
)  # fmt: skip
def test_a_bar_is_as_long_as_its_value_between_its_bounds(actions, action, filled):
    names = ("push", "gas", "brake")[: len(action)]
    frame = Canvas(SEED, WORLD, names=names, actions=actions).draw(
        DriveFrame(plain(RED), np.array(action, np.float32), 0, 0.0)
    )
    width, height = DREAMING.track
    left = width + 16 - len(action) * 122
    row = frame[height + 26 + 22 + 7, left : left + 106]
    assert np.flatnonzero((row == (120, 170, 255)).all(axis=1)).tolist() == list(filled)


@pytest.mark.parametrize(
    ("action", "names", "actions", "name"),
    [
        (np.array([0, 1, 0], np.float32), ("stay", "left", "right"), one_hot(3), "left"),
        (np.array([0, 1, 0], np.float32), (), one_hot(3), "1 of 3"),
        (np.array([2]), (), Discrete(4), "2 of 0 to 3"),
        (np.array([2]), (), None, "2"),
        (np.array([2]), ("up", "down"), Discrete(2, first=1), "down"),
        (np.array([0.2], np.float32), ("push",), Continuous.between([-1], [1]), None),
        (np.array([0.2, 0, 0], np.float32), (), None, None),
    ],
)
def test_a_choice_is_shown_by_its_name(action, names, actions, name):
    assert choice_name(action, names, actions) == name
    frames = [
        Canvas(SEED, WORLD, names=names, actions=actions).draw(DriveFrame(plain(RED), each, 0, 0.0))
        for each in (action, action * 0)
    ]
    assert (name is None) or not np.array_equal(*frames)


@pytest.mark.parametrize(("height", "width"), [(48, 40), (120, 160), (20, 200)])
def test_a_world_keeps_its_shape_beside_the_small_pictures(height, width):
    picture = np.full((height, width, 3), RED, np.uint8)
    for layout, more in ((DREAMING, MODELS), (plain_layout(picture), None)):
        red = (Canvas(SEED, WORLD, layout).draw(DriveFrame(picture, ACTION, 0, 0.0, more)) == RED).all(axis=2)
        rows, columns = np.flatnonzero(red.any(axis=1)), np.flatnonzero(red.any(axis=0))
        assert len(columns) / len(rows) == pytest.approx(width / height, rel=0.02)
        assert len(columns) == layout.track[0] or len(rows) == layout.track[1]


def drive(bundle, steps, every, moved=0.0):
    """The latents of an artificial drive, the dreamt ones, and where each dream started."""
    random, model = np.random.default_rng(0), DreamStep(bundle)
    parameters = random.normal(size=bundle.controller_shape.size).astype(np.float32)
    daydream = ParallelDream(bundle, parameters, ParallelDreamConfig(every=every))
    real = random.normal(size=(steps, 1, model.latent_size)).astype(np.float32)
    real[1:] += np.float32(moved)
    states = random.normal(size=(steps, 1, model.state_size)).astype(np.float32)
    dreamt, since = [], []
    for step in range(steps):
        dreamt.append(daydream.follow(step, real[step], states[step]))
        since.append(daydream.since)
    return real, np.stack(dreamt), since


def test_a_dream_restarts_from_the_drives_latent(random_bundle):
    real, dreamt, since = drive(random_bundle, 10, every=4)
    assert since == [0, 0, 0, 0, 4, 4, 4, 4, 8, 8]
    same = [np.array_equal(one, other) for one, other in zip(real, dreamt, strict=True)]
    assert [step for step, equal in enumerate(same) if equal] == [0, 4, 8]


def test_between_restarts_a_dream_does_not_depend_on_the_drive(random_bundle):
    real, dreamt, _ = drive(random_bundle, 6, every=100)
    other, again, _ = drive(random_bundle, 6, every=100, moved=1.0)
    assert np.array_equal(real[0], other[0])
    assert not np.array_equal(real[1:], other[1:])
    assert np.array_equal(dreamt, again)


@pytest.mark.parametrize("temperature", [0.0, float("nan")])
def test_an_invalid_temperature_is_refused(temperature):
    with pytest.raises(UsageError):
        ParallelDreamConfig(temperature)
