"""Tests recording.py, drive_frames.py, video.py and verb.py."""

import json
import re
from functools import partial

import av
import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host.stop_signals import never_stop
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.recording.canvas import DREAMING, Canvas
from dreamfleet.worker.addons.recording.recording import record, record_in_process
from dreamfleet.worker.addons.recording.video import Video
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import EpisodeConfig
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
        assert recorded("--seed", each["seed"], "--out", alone) == [{**each, "video": str(alone)}]
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
