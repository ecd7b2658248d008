"""`record` takes the same arguments of a controller and of a random driver, and prints the same answers.
Tests verb.py."""

import json
import re

import av
import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import UsageError

FIRST, SECOND, STEPS = 20_000, 20_001, 5


@pytest.fixture(params=["evolved", "random"])
def verb(request, random_bundle, tmp_path):
    if request.param == "random":
        return ["record", "--controller", "random"]
    shape, path = random_bundle.controller_shape, tmp_path / "controller.npz"
    Controller(shape, np.zeros(shape.size, np.float32), "car-racing", random_bundle.sha256).save(path)
    return ["record", "--controller", str(path), "--bundle", str(random_bundle.path)]


def answers(capsys, verb, *words):
    assert command_line.main([*verb, "--steps", str(STEPS), "--json", *map(str, words)]) == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def pictures(video):
    with av.open(str(video)) as container:
        return [each.to_ndarray(format="rgb24").astype(int) for each in container.decode(container.streams.video[0])]


@pytest.mark.slow
def test_each_track_has_its_own_video(verb, tmp_path, capsys):
    both = answers(capsys, verb, "--seed", FIRST, SECOND, FIRST, "--out", tmp_path / "drive.mp4")
    assert [each["seed"] for each in both] == [FIRST, SECOND]
    for each in both:
        video = tmp_path / f"drive-{each['seed']}.mp4"
        assert each["video"] == str(video)
        assert len(pictures(video)) == STEPS
        alone = answers(capsys, verb, "--seed", each["seed"], "--out", tmp_path / "alone.mp4")
        assert alone == [{**each, "video": str(tmp_path / "alone.mp4")}]
        np.testing.assert_allclose(pictures(tmp_path / "alone.mp4"), pictures(video), atol=8)  # x264 differs by a bit


@pytest.mark.long  # whole laps: a mean is shown beside nothing less
def test_without_a_seed_a_shipped_controllers_median_game_is_shown_beside_its_mean(tmp_path, capsys):
    words = ("record", "--controller", "tiny", "--out", str(tmp_path / "drive.mp4"))
    for given, found in (
        ((), r"10060.* 100 .*832\.1 ± 14\.3"),
        (("--seed", "10000", "--steps", "2"), "10000.* 2 .*--steps"),
    ):
        assert command_line.main([*words, *given]) == 0
        assert re.search(found, capsys.readouterr().out)


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
def test_an_invalid_recording_is_one_line_before_the_first_step(verb, words, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.mp4").mkdir()
    assert command_line.main([*verb, *words]) == UsageError.exit_code
    assert named in capsys.readouterr().err
    assert not (tmp_path.parent / "elsewhere").exists()
