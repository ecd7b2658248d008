"""Tests recording.py and drive_frames.py."""

import json
from functools import partial

import av
import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host.stop_signals import never_stop
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.recording.canvas import DREAMING, Canvas
from dreamfleet.worker.addons.recording.recording import record, record_in_process
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import EpisodeConfig
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task

SEED, STEPS = 10_003, 8


@pytest.fixture
def controller(random_bundle):
    shape = random_bundle.controller_shape
    parameters = np.random.default_rng(0).normal(size=shape.size).astype(np.float32)
    return Controller(shape, parameters, "car-racing", random_bundle.sha256)


def test_a_video_has_one_frame_a_step_and_the_drives_score(controller, random_bundle, tmp_path):
    steps, agent = [], make_agent(controller, random_bundle)
    score = record(agent, SEED, STEPS, tmp_path / "new" / "drive.mp4", on_step=steps.append)
    task, assignment = find_task("car-racing"), Assignment.of("car-racing", random_bundle)
    judge = task.make_evaluation_environment(assignment)
    driven = episode.score(judge, task.make_policy(assignment), controller.parameters, EpisodeConfig(SEED, STEPS))
    judge.close()
    assert score == driven.fitness
    assert steps == list(range(1, STEPS + 1))
    with av.open(str(tmp_path / "new" / "drive.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height, stream.average_rate) == (*DREAMING.size, 50)
        assert len(list(container.decode(stream))) == STEPS


@pytest.mark.parametrize(("limit", "number"), [(3, 3), (50, 8)], ids=["limit", "death"])
def test_the_end_of_an_episode_is_held_for_a_second_and_named(limit, number, tmp_path, monkeypatch):
    ends = []
    monkeypatch.setattr(Canvas, "_draw_end", lambda _self, text: ends.append(text))
    arguments = json.dumps({"environment": {"max_episode_steps": limit}})
    falling = Controller(ControllerShape(4, 2), np.zeros(10, np.float32), "gym:CartPole-v1", "", {}, arguments)
    steps = []
    score = record(make_agent(falling), SEED, 1000, tmp_path / "drive.mp4", on_step=steps.append)
    assert (len(ends), str(number) in ends[0], score, steps[-1]) == (1, True, number, number)
    with av.open(str(tmp_path / "drive.mp4")) as container:
        stream = container.streams.video[0]
        *_, one, last = container.decode(stream)
        assert stream.frames == steps[-1] + stream.average_rate
    np.testing.assert_allclose(*(each.to_ndarray(format="rgb24").astype(int) for each in (one, last)), atol=8)


@pytest.mark.parametrize("after", [0, 3])
def test_a_stopped_recording_is_playable(controller, random_bundle, tmp_path, after):
    steps = [0]
    record(
        make_agent(controller, random_bundle), SEED, STEPS, tmp_path / "drive.mp4", on_step=steps.append,
        stop=lambda: steps[-1] >= after,
    )  # fmt: skip
    assert steps[-1] == max(after, 1)
    with av.open(str(tmp_path / "drive.mp4")) as container:
        assert len(list(container.decode(container.streams.video[0]))) == steps[-1]


def test_a_controller_that_was_evolved_in_the_dream_is_recorded_in_reality(controller, random_bundle, tmp_path):
    dreamer = Controller(controller.shape, controller.parameters, "dream", controller.bundle)
    scores = [
        record(make_agent(each, random_bundle), SEED, 3, tmp_path / "drive.mp4") for each in (controller, dreamer)
    ]
    assert scores[0] == scores[1]


def test_floats_with_opacity_are_filmed_in_their_colours(tmp_path, monkeypatch):
    task = "gym:tests.support.pixel_fakes:Glass-v0"
    record(
        make_agent(Controller(ControllerShape(2, 3), np.zeros(9, np.float32), task, "")), SEED, 2, tmp_path / "a.mp4"
    )
    with av.open(str(tmp_path / "a.mp4")) as container:
        frame = next(container.decode(container.streams.video[0])).to_ndarray(format="rgb24")
    green = (frame[..., 1] > 150) & (frame[..., 0] < 80) & (frame[..., 2] < 80)  # the player
    assert green.any()


def save_controller(monkeypatch, name, path):
    """A controller of an environment of `tests.support.dark_environments`, which is trusted."""
    monkeypatch.setenv("DREAMFLEET_TRUST", "tests")
    task = f"gym:tests.support.dark_environments:{name}-v0"
    Controller(ControllerShape(4, 2), np.zeros(10, np.float32), task, "").save(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("Dark", "Dark"),
        ("Blank", "Blank"),
        ("Raising", "ZeroDivisionError: no light"),
        ("Plain", "tests.support.dark_environments:Plain-v0"),
    ],
)
def test_an_environment_that_cannot_be_filmed_ends_with_one_line(processes, tmp_path, monkeypatch, name, named):
    save_controller(monkeypatch, name, tmp_path / "dark.npz")
    for verb in ("record", "live"):
        out = tmp_path / f"{verb}.mp4"
        code, _, err = processes.call(verb, "--controller", tmp_path / "dark.npz", "--out", out)
        assert (code > 0, named in err, "Traceback" in err, "\x1b" in err) == (True, True, False, False), err
        assert list(tmp_path.glob("*.mp4*")) == list(tmp_path.glob(".*")) == []


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("Breaking", "ZeroDivisionError: no road"),
        ("Interrupting", "KeyboardInterrupt:"),
        ("Leaving", "exit status 3"),
    ],
)
def test_an_episode_that_fails_leaves_no_video_and_the_one_that_is_there(processes, tmp_path, monkeypatch, name, error):
    save_controller(monkeypatch, name, tmp_path / "breaking.npz")
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "drive-10001.mp4").write_text("earlier")
    code, _, err = processes.call(
        "record", "--controller", tmp_path / "breaking.npz", "--seed", 10_001, 10_000, "--out",
        tmp_path / "videos" / "drive.mp4",
    )  # fmt: skip
    assert (code, "10001" in err, error in err) == (1, True, True), err
    assert {each.name: each.read_text() for each in (tmp_path / "videos").iterdir()} == {"drive-10001.mp4": "earlier"}


def film_of(name, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_TRUST", "tests")
    task = f"gym:tests.support.dark_environments:{name}-v0"
    return partial(record, make_agent(Controller(ControllerShape(4, 2), np.zeros(10, np.float32), task, "")), steps=900)


@pytest.mark.slow
def test_an_episode_that_hangs_ends_the_recording(tmp_path, monkeypatch):
    with pytest.raises(DreamfleetError):
        record_in_process(film_of("Stuck", monkeypatch), SEED, tmp_path / "drive.mp4", print, never_stop, stall=2.0)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_in_another_process_can_be_stopped(tmp_path, monkeypatch):
    seen = [0]
    film = film_of("Slow", monkeypatch)
    score, steps = record_in_process(film, SEED, tmp_path / "drive.mp4", seen.append, lambda: seen[-1] > 0)
    assert 0 < seen[-1] <= steps < 900
    assert score == steps
    with av.open(str(tmp_path / "drive.mp4")) as container:
        assert len(list(container.decode(container.streams.video[0]))) == steps


def test_another_task_or_an_impossible_place_is_refused(controller, random_bundle, tmp_path):
    moon = Controller(controller.shape, controller.parameters, "moon", controller.bundle)
    with pytest.raises(UsageError):
        record(make_agent(moon, random_bundle), SEED, STEPS, tmp_path / "drive.mp4")
    (tmp_path / "file").write_text("")
    with pytest.raises(DreamfleetError, match="--out"):
        record(make_agent(controller, random_bundle), SEED, STEPS, tmp_path / "file" / "drive.mp4")
