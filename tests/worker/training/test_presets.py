"""Presets match their sources, flags change them, and a data folder keeps the one that it was begun with.
Tests config_flags.py, worker/training/stages/collect.py, worker/verbs/collect.py and worker/verbs/train.py."""

import json
from dataclasses import fields

import numpy as np
import pytest
import torch

from dreamfleet.common.cli.command_line import build_parser, main
from dreamfleet.common.cli.presets import NAMES
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.worker.training import train_mdnrnn
from dreamfleet.worker.training.checkpoint import load_config
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.data_folder import check_seed, load_preset, resolve_preset, store_preset
from dreamfleet.worker.training.data.rollout_batches import Rollouts, load_rollouts, model_inputs, teacher_force
from dreamfleet.worker.training.presets import PRESETS, TrainConfig
from dreamfleet.worker.verbs import collect, train
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import NOTEBOOK, MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.drives import ignore, train_models, write_drive, write_drives
from tests.support.events import scalars
from tests.support.verbs import run_verb

SHORT = TrainConfig(updates=2, batch=8, rate=1e-3)
SMALL = {64: VAEConfig(channels=(2, 2, 4, 4)), 96: VAEConfig(picture=96, channels=(2, 2, 4, 4))}


def call(folder, verb, *words):
    return run_verb(verb, *words, "--data", folder)


def test_every_preset_is_named_for_both_sides_has_a_world_and_records_what_its_vae_sees():
    assert sorted(PRESETS) == sorted(NAMES["training"])
    others = {"pixels": "", "takecover": "takecover"}
    for name, preset in PRESETS.items():
        assert preset.task == others.get(name, "car-racing")
        assert preset.collect.picture == preset.vae_layers.picture


@pytest.mark.slow
@pytest.mark.parametrize("picture", [64, 96])
def test_no_drive_is_mirrored_whose_pictures_show_the_indicators(tmp_path, picture, monkeypatch):
    write_drives(tmp_path, episodes=4, steps=6, picture=picture)
    train_models(tmp_path, SHORT, SMALL[picture])
    assert ("mirrored_mu" in np.load(tmp_path / "encoded" / "000001.npz")) == (picture == 64)
    taken = []

    def watched(paths, mirrored=None):
        taken.extend([] if mirrored is None else mirrored)
        return load_rollouts(paths, mirrored)

    monkeypatch.setattr(train_mdnrnn, "load_rollouts", watched)
    train_mdnrnn.train_mdnrnn(tmp_path, TrainConfig(updates=8, batch=8, rate=1e-3), ignore, MDNRNNConfig(hidden=4))
    assert len(taken) == 24
    assert any(taken) == (picture == 64)


def test_a_drive_follows_from_the_first_reward_in_training_and_behind_it():
    torch.manual_seed(0)
    ones, reward = torch.ones(1, 3), torch.tensor([[3.0, -0.1, 3.0]])
    mu = torch.randn(1, 3, 32)
    rollouts = Rollouts(mu, mu, torch.randn(1, 3, 3), reward, torch.zeros(1, 3), ones)
    inputs = model_inputs(NOTEBOOK, mu, rollouts)
    assert inputs[0, :, -1].tolist() == [1, 0, 1]
    model = MDNRNN(NOTEBOOK).eval()
    with torch.no_grad():
        hidden, states = teacher_force(model, rollouts)
        torch.testing.assert_close(model.predict(hidden).means, model(inputs).means)
    assert states[0][0, 2 * NOTEBOOK.hidden] == 1


@pytest.mark.parametrize(
    ("name", "verb", "kinds"),
    [("collect", collect, (CollectConfig,)), ("train", train, (TrainConfig, VAEConfig, MDNRNNConfig))],
)
def test_every_amount_and_layer_has_a_flag_or_a_key_and_every_flag_says_what_it_does(name, verb, kinds):
    parser = build_parser(name, verb)
    assert [each.dest for each in parser._actions if not each.help] == []
    said = {each.dest for each in parser._actions} | {key for texts in parser.keys.values() for key in texts}
    assert {each.name for kind in kinds for each in fields(kind)} - said <= {"actions"}


def test_a_later_verb_without_the_data_sets_preset_is_refused(tmp_path, capsys):
    assert call(tmp_path, collect, "--preset", "article", "--episodes", 2, "--steps", 3, "--jobs", 1) == 0
    assert load_preset(tmp_path) == "article"
    for verb, *model in ((collect,), (train, "vae"), (train, "mdnrnn")):
        with pytest.raises(UsageError, match="--preset article"):
            call(tmp_path, verb, *model)
        with pytest.raises(UsageError, match=r"--preset paper.*--preset article"):
            call(tmp_path, verb, *model, "--preset", "paper")
    assert call(tmp_path, train, "vae", "--preset", "article", "--summary") == 0
    assert "2,115,971" in capsys.readouterr().out


def test_a_data_set_that_was_not_begun_by_collect_stays_without_a_preset(tmp_path):
    write_drive(tmp_path, 0)
    store_preset(tmp_path, "article", 0)
    assert load_preset(tmp_path) is None
    assert resolve_preset(tmp_path, "paper") == "paper"
    assert resolve_preset(tmp_path, None) == "tiny"


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"preset": "paper"}', '{"preset": "dream", "task": "car-racing"}', "[" * 900]
)
def test_a_damaged_preset_file_is_reported_in_a_line(tmp_path, content):
    (tmp_path / "preset.json").write_text(content)
    with pytest.raises(DatasetError):
        resolve_preset(tmp_path, None)


def test_a_data_set_has_one_preset_and_one_seed(tmp_path):
    check_seed(tmp_path, 7)
    store_preset(tmp_path, "paper", 5)
    store_preset(tmp_path, "tiny", 6)
    assert json.loads((tmp_path / "preset.json").read_text()) == {"preset": "paper", "seed": 5, "task": "car-racing"}
    check_seed(tmp_path, 5)
    with pytest.raises(UsageError, match=r"--seed 5.*--seed 7"):
        check_seed(tmp_path, 7)
    (tmp_path / "preset.json").write_text('{"preset": "paper", "task": "car-racing"}')  # no seed is kept
    check_seed(tmp_path, 7)


def test_a_flag_says_how_large_pictures_are(tmp_path, capsys):
    write_drives(tmp_path, episodes=3, steps=4, picture=96)
    call(tmp_path, train, "vae", "--updates", 1, "--set", "picture=96", "channels=2,2,4,4")
    assert load_config(tmp_path / "vae.safetensors", VAEConfig).picture == 96
    capsys.readouterr()
    assert call(tmp_path, collect, "--episodes", 3, "--picture", 96, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["new_episodes"], found["new_frames"], found["episodes"]) == (0, 0, 3)
    with pytest.raises(DatasetError, match="--picture"):
        call(tmp_path, collect, "--episodes", 4)


def test_a_set_that_has_more_than_is_asked_for_is_counted_whole(tmp_path, capsys):
    write_drives(tmp_path, episodes=3, steps=4)
    write_drive(tmp_path, 7, steps=4)
    assert call(tmp_path, collect, "--episodes", 4, "--jobs", 1, "--preset", "tiny", "--json") == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert (found["new_episodes"], found["episodes"], "5/5" in printed.err) == (1, 5, True)


def test_a_file_and_variables_say_settings_too(tmp_path, monkeypatch, capsys):
    write_drives(tmp_path, episodes=3, steps=4)
    (tmp_path / "settings.toml").write_text("[vae]\nchannels = [2, 2, 4, 4]\nlatent = 9\nkl_tolerance = 1\n")
    monkeypatch.setenv("DREAMFLEET_VAE_LATENT", "8")
    words = ["train", "vae", "--data", str(tmp_path), "--config", str(tmp_path / "settings.toml"), "--updates", "1"]
    assert main([*words, "--set", "kl_tolerance=0.25"]) == 0
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
    assert main(["train", *words, "--data", str(tmp_path)]) == UsageError.exit_code
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(("model", "count"), [("vae", "4,348,547"), ("mdnrnn", "422,368")])
def test_a_summary_trains_nothing(tmp_path, capsys, model, count):
    assert call(tmp_path / "absent", train, model, "--preset", "paper", "--summary") == 0
    assert count in capsys.readouterr().out


def test_a_set_goes_on_with_drives_of_controllers(tmp_path, capsys):
    write_drives(tmp_path, episodes=3, steps=4)
    flags = ("--episodes", 4, "--jobs", 1, "--steps", 5, "--runs-dir", tmp_path)
    assert call(tmp_path, collect, *flags, "--controller", "tiny", "--noise", 0.1, "--json") == 0
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
        call(tmp_path, collect, *flags)


def test_losses_go_to_tensorboard_too_and_a_continued_training_adds_to_them(tmp_path):
    data, events = tmp_path / "data", tmp_path / "events"
    write_drives(data, episodes=3, steps=4)
    settings = ("--set", "channels=2,2,4,4", "validate_every=1", "--tensorboard", events)
    for updates in (1, 3):
        call(data, train, "vae", *settings, "--updates", updates)
    points = [json.loads(line) for line in (data / "vae.jsonl").read_text().splitlines()]
    found = scalars(events / "vae")
    assert [step for step, _ in found["loss/held_out"]] == [1, 2, 3]
    assert [value for _, value in found["loss/held_out"]] == pytest.approx([each["held_out"] for each in points])
