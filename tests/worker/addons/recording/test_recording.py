"""Tests canvas.py, drive_frames.py, parallel_dream.py, recording.py, verb.py, video.py and
common/addons/worlds/takecover.py."""

import json
import re
from dataclasses import replace
from functools import partial

import av
import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE, Continuous, Discrete, one_hot
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host.stop_signals import never_stop
from dreamfleet.common.worlds.score_words import profile_of
from dreamfleet.worker.addons.evaluation.agents import make_agent
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
from dreamfleet.worker.addons.recording.recording import record, record_in_process
from dreamfleet.worker.addons.recording.video import Video
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import EpisodeConfig
from dreamfleet.worker.worldmodel.inference import DreamStep
from tests.support.disks import small_disk
from tests.support.processes import call_here
from tests.support.variants import controller_of

SEED, STEPS = 10_003, 8


def pictures(video):
    with av.open(str(video)) as container:
        return [each.to_ndarray(format="rgb24").astype(int) for each in container.decode(container.streams.video[0])]


@pytest.fixture
def agent(random_bundle):
    return make_agent(controller_of(random_bundle), random_bundle)


def test_a_video_has_one_frame_a_step_and_the_drives_score(agent, tmp_path):
    steps, out = [], tmp_path / "new" / "drive.mp4"
    score, _ = record(agent, SEED, STEPS, out, on_step=steps.append)
    judge = agent.make_evaluation_environment()
    driven = episode.score(judge, agent.make_policies()(SEED), agent.parameters, EpisodeConfig(SEED, STEPS))
    judge.close()
    assert (score, steps) == (driven.fitness, list(range(1, STEPS + 1)))
    with av.open(str(out)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height, stream.average_rate) == (*DREAMING.size, 50)
    assert len(pictures(out)) == STEPS


@pytest.mark.parametrize(("limit", "number"), [(3, 3), (50, 8)], ids=["limit", "death"])
def test_the_end_of_an_episode_is_held_for_a_second_and_named(limit, number, tmp_path, monkeypatch):
    ends = []
    monkeypatch.setattr(Canvas, "_draw_end", lambda _self, text: ends.append(text))
    arguments = json.dumps({"environment": {"max_episode_steps": limit}})
    falling = Controller(ControllerShape(4, 2), np.zeros(10, np.float32), "gym:CartPole-v1", "", {}, arguments)
    steps = []
    score, _ = record(make_agent(falling), SEED, 1000, tmp_path / "drive.mp4", on_step=steps.append)
    assert (len(ends), str(number) in ends[0], score, steps[-1]) == (1, True, number, number)
    shown = pictures(tmp_path / "drive.mp4")
    assert len(shown) == number + 50
    np.testing.assert_allclose(*shown[-2:], atol=8)


@pytest.mark.parametrize("after", [0, 3])
def test_a_stopped_recording_is_playable(agent, tmp_path, after):
    steps, out = [0], tmp_path / "drive.mp4"
    record(agent, SEED, STEPS, out, on_step=steps.append, stop=lambda: steps[-1] >= after)
    assert steps[-1] == len(pictures(out)) == max(after, 1)


def dark_controller(name, monkeypatch):
    """A controller of an environment of `tests.support.dark_environments`, which is trusted."""
    monkeypatch.setenv("DREAMFLEET_TRUST", "tests")
    task = f"gym:tests.support.dark_environments:{name}-v0"
    return Controller(ControllerShape(4, 2), np.zeros(10, np.float32), task, "")


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
def test_an_environment_that_cannot_be_filmed_ends_with_one_line(tmp_path, monkeypatch, capsys, name, named):
    dark_controller(name, monkeypatch).save(tmp_path / "dark.npz")
    for verb in ("record", "live"):
        words = [verb, "--controller", str(tmp_path / "dark.npz"), "--out", str(tmp_path / f"{verb}.mp4")]
        code, err = command_line.main(words), capsys.readouterr().err
        assert (code > 0, named in err, "\x1b" in err) == (True, True, False), err
        assert list(tmp_path.glob("*.mp4*")) == list(tmp_path.glob(".*")) == []


@pytest.mark.parametrize(
    ("name", "error"),
    [("Breaking", "ZeroDivisionError: no road"), ("Interrupting", "KeyboardInterrupt:"), ("Leaving", "exit status 3")],
)
def test_an_episode_that_fails_leaves_no_video_and_the_one_that_is_there(tmp_path, monkeypatch, name, error):
    dark_controller(name, monkeypatch).save(tmp_path / "breaking.npz")
    videos = tmp_path / "videos"
    videos.mkdir()
    (videos / "drive-10001.mp4").write_text("earlier")
    words = ("--controller", tmp_path / "breaking.npz", "--seed", 10_001, 10_000, "--out", videos / "drive.mp4")
    code, _, err = call_here("record", *words)
    assert (code, "10001" in err, error in err) == (1, True, True), err
    assert {each.name: each.read_text() for each in videos.iterdir()} == {"drive-10001.mp4": "earlier"}


def film_of(name, monkeypatch):
    return partial(record, make_agent(dark_controller(name, monkeypatch)), steps=900)


@pytest.mark.slow
def test_an_episode_that_hangs_ends_the_recording(tmp_path, monkeypatch):
    with pytest.raises(DreamfleetError):
        record_in_process(film_of("Stuck", monkeypatch), SEED, tmp_path / "drive.mp4", print, never_stop, stall=2.0)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_in_another_process_can_be_stopped(tmp_path, monkeypatch):
    seen, out = [0], tmp_path / "drive.mp4"
    score, steps = record_in_process(film_of("Slow", monkeypatch), SEED, out, seen.append, lambda: seen[-1] > 0)
    assert 0 < seen[-1] <= steps < 900
    assert score == steps == len(pictures(out))


@pytest.mark.slow
def test_each_track_has_its_own_video(tmp_path):
    def recorded(*words):
        code, out, err = call_here("record", "--controller", "random", "--steps", 5, "--json", *words)
        assert code == 0, err
        return [json.loads(line) for line in out.splitlines()]

    both = recorded("--seed", 20_000, 20_001, 20_000, "--out", tmp_path / "drive.mp4")
    assert [each["seed"] for each in both] == [20_000, 20_001]
    for each in both:
        video, alone = tmp_path / f"drive-{each['seed']}.mp4", tmp_path / "alone.mp4"
        assert (each["video"], len(pictures(video))) == (str(video), 5)
        assert recorded("--seed", each["seed"], "--out", alone) == [
            {**each, "video": str(alone), "replaced": each is both[1]}
        ]
        np.testing.assert_allclose(pictures(alone), pictures(video), atol=8)  # x264 differs by a bit


@pytest.mark.long  # whole laps: a mean is shown beside nothing less
def test_without_a_seed_a_shipped_controllers_median_game_is_shown_beside_its_mean(tmp_path):
    for given, found in (
        ((), r"10060.* 100 .*832\.1 ± 14\.3"),
        (("--seed", "10000", "--steps", "2"), "10000.* 2 .*--steps"),
    ):
        code, out, err = call_here("record", "--controller", "tiny", "--out", tmp_path / "drive.mp4", *given)
        assert (code, bool(re.search(found, out))) == (0, True), (out, err)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--steps", "0"), "--steps"),
        (("--seed", "7", "-1"), "--steps"),
        (("--out", "drive.avi"), "drive.avi"),
        (("--out", "folder.mp4"), "folder.mp4"),
        (("--out", "../elsewhere/drive.mp4"), "../elsewhere"),
    ],
)
def test_an_invalid_recording_is_one_line_before_the_first_step(words, named, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.mp4").mkdir()
    code, _, err = call_here("record", "--controller", "random", *words)
    assert (code, named in err) == (UsageError.exit_code, True)
    assert not (tmp_path.parent / "elsewhere").exists()


def test_an_impossible_place_is_refused(agent, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DreamfleetError, match="--out"):
        record(agent, SEED, STEPS, tmp_path / "file" / "drive.mp4")


NOISE = np.random.default_rng(1).integers(0, 255, (128, 128, 3)).astype(np.uint8)


def film(path, pictures, error=None, **more):
    with Video(path, 10, **more) as video:
        for _ in range(pictures):
            video.add(NOISE)
        if error is not None:
            raise error


@pytest.mark.parametrize("keep_partial", [False, True])
@pytest.mark.parametrize("pictures", [1, 200])  # written as the video ends, and before
def test_a_full_disk_is_named_and_keeps_no_part(tmp_path, keep_partial, pictures):
    with small_disk(tmp_path / "disk", 1) as disk:
        if disk is None:
            pytest.skip("no right to mount a disk")
        disk.fill()
        with pytest.raises(DreamfleetError, match=r"drive\.mp4"):
            film(disk.path / "drive.mp4", pictures, keep_partial=keep_partial)
        disk.free()
        assert list(disk.path.iterdir()) == []
        film(disk.path / "drive.mp4", 2)
        assert [each.name for each in disk.path.iterdir()] == ["drive.mp4"]


@pytest.mark.parametrize(("keep_partial", "kept"), [(False, []), (True, ["drive.mp4"])])
def test_an_error_of_the_drive_is_the_drives_own(tmp_path, keep_partial, kept):
    with pytest.raises(FileNotFoundError, match="of the simulator"):
        film(tmp_path / "drive.mp4", 1, keep_partial=keep_partial, error=FileNotFoundError(2, "of the simulator"))
    assert [each.name for each in tmp_path.iterdir()] == kept


WORLD = profile_of("car-racing")
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


def followed(bundle, steps, every, moved=0.0):
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
    real, dreamt, since = followed(random_bundle, 10, every=4)
    assert since == [0, 0, 0, 0, 4, 4, 4, 4, 8, 8]
    same = [np.array_equal(one, other) for one, other in zip(real, dreamt, strict=True)]
    assert [step for step, equal in enumerate(same) if equal] == [0, 4, 8]


def test_between_restarts_a_dream_does_not_depend_on_the_drive(random_bundle):
    real, dreamt, _ = followed(random_bundle, 6, every=100)
    other, again, _ = followed(random_bundle, 6, every=100, moved=1.0)
    assert np.array_equal(real[0], other[0])
    assert not np.array_equal(real[1:], other[1:])
    assert np.array_equal(dreamt, again)


@pytest.mark.parametrize("temperature", [0.0, float("nan")])
def test_an_invalid_temperature_is_refused(temperature):
    with pytest.raises(UsageError):
        ParallelDreamConfig(temperature)
