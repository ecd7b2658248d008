"""Tests config_flags.py, worker/training/stages/collect.py, worker/verbs/collect.py and worker/verbs/train.py."""

import json

import numpy as np
import pytest

from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.worker.training.checkpoint import load_config
from dreamfleet.worker.verbs import collect, train
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.drives import write_drive, write_drives
from tests.support.events import scalars
from tests.support.verbs import run_verb


def test_flags_change_what_a_preset_says(tmp_path, capsys):
    write_drives(tmp_path, episodes=3, steps=4)
    run_verb(
        train, "vae", "--data", str(tmp_path), "--updates", "1", "--set", "channels=2,2,4,4", "batch_norm=false",
        "--set", "padding=same",
    )  # fmt: skip
    assert load_config(tmp_path / "vae.safetensors", VAEConfig) == VAEConfig(channels=(2, 2, 4, 4), padding="same")
    assert "reconstruction_error" in capsys.readouterr().out


def test_a_flag_says_how_large_pictures_are(tmp_path, capsys):
    write_drives(tmp_path, episodes=3, steps=4, picture=96)
    run_verb(train, "vae", "--data", str(tmp_path), "--updates", "1", "--set", "picture=96", "channels=2,2,4,4")
    assert load_config(tmp_path / "vae.safetensors", VAEConfig).picture == 96
    capsys.readouterr()
    assert run_verb(collect, "--data", str(tmp_path), "--episodes", "3", "--picture", "96", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["new_episodes"], found["new_frames"], found["episodes"]) == (0, 0, 3)
    with pytest.raises(DatasetError, match="--picture"):
        run_verb(collect, "--data", str(tmp_path), "--episodes", "4")


def test_a_set_that_has_more_than_is_asked_for_is_counted_whole(tmp_path, capsys):
    write_drives(tmp_path, episodes=3, steps=4)
    write_drive(tmp_path, 7, steps=4)
    flags = ("--episodes", "4", "--jobs", "1", "--preset", "tiny")
    assert run_verb(collect, "--data", str(tmp_path), *flags, "--json") == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert (found["new_episodes"], found["episodes"], "5/5" in printed.err) == (1, 5, True)


def test_a_file_and_variables_say_settings_too(tmp_path, monkeypatch, capsys):
    write_drives(tmp_path, episodes=3, steps=4)
    (tmp_path / "settings.toml").write_text("[vae]\nchannels = [2, 2, 4, 4]\nlatent = 9\nkl_tolerance = 1\n")
    monkeypatch.setenv("DREAMFLEET_VAE_LATENT", "8")
    words = ["train", "vae", "--data", str(tmp_path), "--config", str(tmp_path / "settings.toml"), "--updates", "1"]
    assert command_line.main([*words, "--set", "kl_tolerance=0.25"]) == 0
    found = load_config(tmp_path / "vae.safetensors", VAEConfig)
    assert found == VAEConfig(channels=(2, 2, 4, 4), latent=8, kl_tolerance=0.25)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("vae", "--latent", "64"), "--set latent=64"),
        (("vae", "--channels", "2", "4"), "--set channels=2,4"),
        (("mdnrnn", "--done"), "--set done=true"),
        (("vae", "--no-batch-norm"), "--set batch_norm=false"),
        (("vae", "--set", "latnt=3"), "latnt"),
        (("vae", "--set", "hidden=3"), "'hidden'"),
        (("vae", "--set", "xyzzy=3"), "updates, batch, rate"),
        (("vae", "--set", "latent"), "--set 'latent'"),
        (("vae", "--set", "latent=many"), "'many'"),
        (("vae", "--set", "channels=2,x"), "'x'"),
        (("vae", "--set", "padding=odd"), "valid, same"),
        (("mdnrnn", "--decoder-only"), "--decoder-only"),
    ],
)
def test_a_wrong_setting_is_one_line_with_the_right_one(tmp_path, capsys, words, named):
    assert command_line.main(["train", *words, "--data", str(tmp_path)]) == UsageError.exit_code
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(("model", "count"), [("vae", "4,348,547"), ("mdnrnn", "422,368")])
def test_a_summary_trains_nothing(tmp_path, capsys, model, count):
    assert run_verb(train, model, "--data", str(tmp_path / "absent"), "--preset", "paper", "--summary") == 0
    assert count in capsys.readouterr().out


def test_a_set_goes_on_with_drives_of_controllers(tmp_path, capsys):
    write_drives(tmp_path, episodes=3, steps=4)
    flags = ("--episodes", "4", "--jobs", "1", "--steps", "5", "--runs-dir", str(tmp_path))
    assert run_verb(collect, "--data", str(tmp_path), *flags, "--controller", "tiny", "--noise", "0.1", "--json") == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 4
    with np.load(tmp_path / "episodes" / "000003.npz") as drive:
        assert (str(drive["driver"]), len(drive["action"])) == ("controller", 5)


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--noise", "0.1"), "--controller"),
        (("--spells", "0.1"), "--controller"),
        (("--driver", "network", "--controller", "tiny"), "--driver.*--controller"),
        (("--driver", "ghost"), "random, held, .*network.*'ghost'"),
        (("--from-run", "r", "--controller", "tiny"), "--controller"),
    ],
)
def test_flags_of_controllers_that_do_not_drive_are_refused(tmp_path, flags, named):
    with pytest.raises(UsageError, match=named):
        run_verb(collect, "--data", str(tmp_path), *flags)


def test_losses_go_to_tensorboard_too_and_a_continued_training_adds_to_them(tmp_path, capsys):
    data, events = tmp_path / "data", tmp_path / "events"
    write_drives(data, episodes=3, steps=4)
    settings = ("--set", "channels=2,2,4,4", "validate_every=1")
    flags = ("vae", "--data", str(data), *settings, "--tensorboard", str(events))
    for updates in ("1", "3"):
        run_verb(train, *flags, "--updates", updates)
    points = [json.loads(line) for line in (data / "vae.jsonl").read_text().splitlines()]
    found = scalars(events / "vae")
    assert [step for step, _ in found["loss/held_out"]] == [1, 2, 3]
    assert [value for _, value in found["loss/held_out"]] == pytest.approx([each["held_out"] for each in points])
