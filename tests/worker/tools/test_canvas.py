import numpy as np
import pytest

from dreamfleet.worker.tools.canvas import (
    AWAKE,
    BACKGROUND,
    DREAMING,
    MARGIN,
    SIDE,
    Canvas,
    DreamPicture,
    DriveFrame,
    ModelPictures,
)

SEED = 10_003
RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
ACTION = np.array([0.0, 0.5, 1.0], np.float32)


def plain(colour):
    return np.full((64, 64, 3), colour, np.uint8)


def test_a_frame_shows_the_track_the_observation_and_the_decoded_latent():
    green = plain(GREEN)
    green[:, ::2] = 0  # an edge a pixel: enlarging must not blur it
    frame = Canvas(SEED).draw(DriveFrame(plain(RED), ACTION, 7, 12.5, ModelPictures(green, plain(BLUE))))
    assert frame.shape[1::-1] == AWAKE.size
    assert (frame[200, 300] == RED).all()
    assert {tuple(pixel) for pixel in frame[100, 620:812].tolist()} == {GREEN, (0, 0, 0)}
    assert (frame[400, 700] == BLUE).all()
    assert not (frame[420:, :240] == BACKGROUND).all(), "score, step and track are written there"


@pytest.mark.parametrize("since", [0, 9900])
def test_a_dreamt_picture_and_its_label_fit_into_the_frame(since):
    moment = DriveFrame(
        plain(RED), ACTION, 7, 12.5, ModelPictures(plain(GREEN), plain(BLUE), DreamPicture(plain(WHITE), since))
    )
    frame = Canvas(SEED, DREAMING).draw(moment)
    assert frame.shape[1::-1] == DREAMING.size
    column = frame[:, DREAMING.track[0] + 20 :][:, :SIDE]
    heights = [int((column == colour).all(axis=(1, 2)).sum()) for colour in (GREEN, BLUE, WHITE)]
    assert heights == [SIDE] * 3
    assert (frame[:, -MARGIN // 2 :] == BACKGROUND).all(), "a label runs out of the frame"
    assert (frame[-MARGIN:] == BACKGROUND).all()
