"""Presets match their sources; a data folder keeps the preset it was begun with."""

import json
from argparse import ArgumentParser
from dataclasses import fields

import pytest
import torch

from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.common.cli.presets import NAMES
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.data_folder import check_seed, load_preset, resolve_preset, store_preset
from dreamfleet.worker.training.data.dataset import load_arrays
from dreamfleet.worker.training.data.rollouts import Rollouts, load_rollouts, model_inputs, teacher_force
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.presets import PRESETS, TrainConfig
from dreamfleet.worker.verbs import collect, train
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import NOTEBOOK, REWARDED, MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import PAPER, VAEConfig
from tests.support.drives import ignore, write_drive, write_drives
from tests.support.verbs import run_verb

SHORT = TrainConfig(updates=2, batch=8, rate=1e-3)
SMALL = {64: VAEConfig(channels=(2, 2, 4, 4)), 96: VAEConfig(picture=96, channels=(2, 2, 4, 4))}
VERBS = ((collect,), (train, "vae"), (train, "mdnrnn"))


def test_tiny_is_what_it_was():
    tiny = PRESETS["tiny"]
    assert tiny.collect == CollectConfig(episodes=620, steps=300, anywhere=0.6, patience=120, driver="random")
    assert tiny.vae == TrainConfig(updates=1500, batch=100, rate=5e-4, clip=0)
    assert tiny.mdnrnn == TrainConfig(updates=800, batch=32, rate=1e-3)
    assert (tiny.vae_layers, tiny.mdnrnn_layers) == (PAPER, REWARDED)


@pytest.mark.parametrize(
    ("name", "episodes", "steps", "driver"),
    [("notebook", 1000, 300, "uniform"), ("article", 2000, 300, "pushed"), ("paper", 10_000, 1000, "network")],
)
def test_a_sources_drives_begin_at_the_tracks_beginning_and_last_their_steps(name, episodes, steps, driver):
    drives = PRESETS[name].collect
    assert (drives.episodes, drives.steps, drives.driver) == (episodes, steps, driver)
    assert (drives.anywhere, drives.patience) == (0, 0)
    assert PRESETS[name].vae.rate == 1e-4


def test_the_notebooks_trainings_end_with_their_last_update():
    notebook = PRESETS["notebook"]
    assert (notebook.vae.updates, notebook.mdnrnn.updates) == (30_000, 10_000)
    assert (notebook.vae.patience, notebook.mdnrnn.patience) == (0, 0)
    assert (notebook.mdnrnn_layers.z_factor, notebook.mdnrnn_layers.reward_factor) == (1, 1)
    assert notebook.mdnrnn_layers.reward == "notebook"
    assert PRESETS["attentive"].collect.steps == 384


def test_take_covers_models_predict_no_reward_and_weigh_its_ends_and_small_things():
    preset = PRESETS["takecover"]
    assert (preset.task, preset.collect.driver, preset.mdnrnn_layers.outputs) == ("takecover", "held", 961)
    assert (preset.vae_layers.pixel_weight, preset.mdnrnn_layers.done_weight) == (3, 3)
    assert preset.collect.steps == 525  # decisions of 4 tics, 2,100 tics


def test_other_presets_are_of_the_first_world_but_pixels_which_is_of_any():
    assert {name: each.task for name, each in PRESETS.items() if each.task != "car-racing"} == {
        "pixels": "", "takecover": "takecover",
    }  # fmt: skip


def test_every_preset_is_named_for_both_sides():
    assert sorted(PRESETS) == sorted(NAMES["training"])


@pytest.mark.slow
@pytest.mark.parametrize("picture", [64, 96])
def test_no_drive_is_mirrored_whose_pictures_show_the_indicators(tmp_path, picture, monkeypatch):
    write_drives(tmp_path, episodes=4, steps=6, picture=picture)
    train_vae.train_vae(tmp_path, SHORT, ignore, SMALL[picture])
    assert len(list(encode(tmp_path))) == 4
    path = tmp_path / "encoded" / "000001.npz"
    if picture == 96:
        with pytest.raises(DatasetError):
            load_arrays(path, "mirrored_mu")
    else:
        assert len(load_arrays(path, "mirrored_mu")["mirrored_mu"]) == 5
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


@pytest.mark.parametrize("verb", [collect, train])
def test_every_flag_says_what_it_does(verb):
    parser = ArgumentParser()
    verb.configure(parser)
    assert [each.dest for each in parser._actions if not each.help] == []
    assert parser.format_help()


@pytest.mark.parametrize(
    ("verb", "kinds"), [("collect", (CollectConfig,)), ("train", (TrainConfig, VAEConfig, MDNRNNConfig))]
)
def test_every_amount_and_layer_has_a_flag_or_a_key(verb, kinds):
    parser = build_parser(verb, {"collect": collect, "train": train}[verb])
    said = {each.dest for each in parser._actions} | {key for texts in parser.keys.values() for key in texts}
    assert {each.name for kind in kinds for each in fields(kind)} - said <= {"actions"}


def test_a_later_verb_without_the_data_sets_preset_is_refused(tmp_path, capsys):
    assert (
        run_verb(
            collect, "--data", str(tmp_path), "--preset", "article", "--episodes", "2", "--steps", "3", "--jobs", "1"
        )
        == 0
    )
    assert load_preset(tmp_path) == "article"
    for verb, *model in VERBS:
        with pytest.raises(UsageError, match="--preset article"):
            run_verb(verb, *model, "--data", str(tmp_path))
        with pytest.raises(UsageError, match=r"--preset paper.*--preset article"):
            run_verb(verb, *model, "--data", str(tmp_path), "--preset", "paper")
    assert run_verb(train, "vae", "--data", str(tmp_path), "--preset", "article", "--summary") == 0
    assert "2,115,971" in capsys.readouterr().out


def test_a_data_set_from_before_presets_were_kept_stays_without_one(tmp_path):
    write_drive(tmp_path, 0)
    store_preset(tmp_path, "article", 0)
    assert load_preset(tmp_path) is None
    assert resolve_preset(tmp_path, "paper") == "paper"
    assert resolve_preset(tmp_path, None) == "tiny"


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"preset": 5}', '{"preset": "dream"}', "[" * 900])
def test_a_damaged_preset_file_is_reported_in_a_line(tmp_path, content):
    (tmp_path / "preset.json").write_text(content)
    with pytest.raises(DatasetError):
        resolve_preset(tmp_path, None)


def test_a_preset_is_kept_once(tmp_path):
    store_preset(tmp_path, "paper", 5)
    store_preset(tmp_path, "tiny", 6)
    assert json.loads((tmp_path / "preset.json").read_text()) == {"preset": "paper", "seed": 5}


def test_a_data_set_has_one_seed(tmp_path):
    check_seed(tmp_path, 7)
    store_preset(tmp_path, "paper", 5)
    check_seed(tmp_path, 5)
    with pytest.raises(UsageError, match=r"--seed 5.*--seed 7"):
        check_seed(tmp_path, 7)
    (tmp_path / "preset.json").write_text('{"preset": "paper"}')  # from before seeds were kept
    check_seed(tmp_path, 7)
