import av
import numpy as np
import pytest

from common.controller import Controller
from common.errors import DreamfleetError, UsageError
from worker.recording import BACKGROUND, FRAMES_PER_SECOND, HEIGHT, WIDTH, Canvas, Moment, record
from worker.rollout import Course, rollout
from worker.tasks.api import find_task

SEED, STEPS = 10_003, 8


@pytest.fixture
def controller(random_bundle):
    shape = random_bundle.controller_shape
    parameters = np.random.default_rng(0).normal(size=shape.size).astype(np.float32)
    return Controller(shape, parameters, "car-racing", random_bundle.sha256)


def test_a_video_has_a_frame_a_step_and_the_drives_own_score(controller, random_bundle, tmp_path):
    told = []
    score = record(controller, random_bundle, SEED, STEPS, tmp_path / "new" / "drive.mp4", told.append)
    task = find_task("car-racing")
    judge = task.make_judge()
    driven = rollout(judge, task.make_policy(random_bundle), controller.parameters, Course(SEED, STEPS))
    judge.close()
    assert score == driven.fitness
    assert told == list(range(1, STEPS + 1))
    with av.open(str(tmp_path / "new" / "drive.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height, stream.average_rate) == (WIDTH, HEIGHT, FRAMES_PER_SECOND)
        assert len(list(container.decode(stream))) == STEPS


def test_a_frame_shows_the_track_what_is_seen_and_what_is_decoded():
    red, green, blue = (np.full((64, 64, 3), colour, np.uint8) for colour in ((255, 0, 0), (0, 255, 0), (0, 0, 255)))
    green[:, ::2] = 0  # an edge a pixel: enlarging must not blur it
    frame = Canvas(SEED).draw(Moment(red, green, blue, np.array([0.0, 0.5, 1.0], np.float32), 7, 12.5))
    assert frame.shape == (HEIGHT, WIDTH, 3)
    assert (frame[200, 300] == (255, 0, 0)).all()
    assert {tuple(pixel) for pixel in frame[100, 620:812].tolist()} == {(0, 255, 0), (0, 0, 0)}
    assert (frame[400, 700] == (0, 0, 255)).all()
    assert not (frame[420:, :240] == BACKGROUND).all(), "score, step and track are written there"


def test_another_task_or_an_impossible_place_is_refused(controller, random_bundle, tmp_path):
    moon = Controller(controller.shape, controller.parameters, "moon", controller.bundle)
    with pytest.raises(UsageError, match="only car-racing"):
        record(moon, random_bundle, SEED, STEPS, tmp_path / "drive.mp4")
    (tmp_path / "file").write_text("")
    with pytest.raises(DreamfleetError, match="choose another --out"):
        record(controller, random_bundle, SEED, STEPS, tmp_path / "file" / "drive.mp4")
