"""Presets match their sources, flags change them, and a data folder keeps the one that it was begun with;
factors weight the parts of a loss.
Tests config_flags.py, worker/training/data/rollout_batches.py, worker/training/stages/collect.py,
worker/verbs/collect.py, worker/verbs/train.py and worker/worldmodel/config_fields.py."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from dreamfleet.common.cli.command_line import build_parser, main
from dreamfleet.common.cli.presets import NAMES
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.checkpoint import load_config, load_progress, load_weights
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.data_folder import check_seed, load_preset, resolve_preset, store_preset
from dreamfleet.worker.training.data.rollout_batches import (
    Rollouts,
    done_labels,
    load_rollouts,
    model_inputs,
    teacher_force,
)
from dreamfleet.worker.training.prediction_quality import end_quality
from dreamfleet.worker.training.presets import PRESETS, TrainConfig
from dreamfleet.worker.verbs import collect, train
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, binary_loss
from dreamfleet.worker.worldmodel.mdnrnn_config import NOTEBOOK, MDNRNNConfig, calibrate_end
from dreamfleet.worker.worldmodel.vae import VAE, PixelWeights
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.drives import ignore, linked, train_models, write_drive, write_drives, write_encoded
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


LAYERS, RNN = VAEConfig(latent=4, channels=(4, 4, 8, 8)), MDNRNNConfig(latent=4, hidden=8, mixtures=2)
ENDING = replace(RNN, done=True)
BRIEF = TrainConfig(updates=2, batch=8, rate=1e-3, validate_every=1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_drives(folder, episodes=4, steps=8)
    return train_models(folder, BRIEF, LAYERS, RNN)


@pytest.mark.parametrize(("loss", "scale"), [("paper", 1), ("notebook", 1000 / (3 * 64**2))])
def test_the_error_is_weighed_against_the_divergence(loss, scale):
    torch.manual_seed(0)
    model = VAE(replace(LAYERS, loss=loss, error_factor=4.0, kl_tolerance=0.0))
    found = model.loss(torch.rand(2, 3, 64, 64), torch.randn(2, 4))
    torch.testing.assert_close(found.weighted, 4 * scale * found.error + found.divergence)
    torch.testing.assert_close(found.plain, scale * found.error + found.divergence)


@pytest.fixture(scope="module")
def rollouts(trained):
    return load_rollouts(sorted((trained / "encoded").glob("*.npz")))


def gradients(rollouts, **changes):
    """Those of the heads, and the reported losses."""
    torch.manual_seed(0)
    model = MDNRNN(replace(RNN, **changes))
    reported = train_mdnrnn.backward(model, rollouts, torch.Generator().manual_seed(0))
    return model.heads.weight.grad, reported


def test_latents_and_rewards_are_weighted_in_the_gradients_and_not_in_reported_losses(rollouts):
    factors = {}, {"reward_factor": 3.0}, {"z_factor": 2.0}, {"z_factor": 2.0, "reward_factor": 3.0}
    (plain, rewards, latents, both), reported = zip(*(gradients(rollouts, **each) for each in factors), strict=True)
    assert all(each == reported[0] for each in reported)
    torch.testing.assert_close(both, rewards + latents - plain)
    torch.testing.assert_close(rewards[-1], 3 * plain[-1])  # the reward head's row
    torch.testing.assert_close(latents[:-1], 2 * plain[:-1])


def test_ends_are_weighted_as_a_class_and_as_a_part(rollouts):
    never, ended = (replace(rollouts, done=value * rollouts.mask) for value in (0, 1))
    plain, reported = gradients(ended, done=True)
    whole, weighted = gradients(ended, done=True, done_factor=3.0)
    assert weighted == reported
    torch.testing.assert_close(whole[-1], 3 * plain[-1])  # the done head's row
    torch.testing.assert_close(gradients(ended, done=True, done_weight=3.0)[0], whole)
    assert torch.equal(gradients(never, done=True, done_weight=3.0)[0], gradients(never, done=True)[0])
    assert torch.equal(whole[:-1], plain[:-1])


def test_a_training_goes_on_under_its_own_factors_only(trained):
    with pytest.raises(DatasetError, match=r"error_factor.*1\.0.*4\.0"):
        train_vae.train_vae(trained, BRIEF, ignore, replace(LAYERS, error_factor=4.0))
    with pytest.raises(DatasetError, match=r"z_factor.*1\.0.*2\.0"):
        train_mdnrnn.train_mdnrnn(trained, BRIEF, ignore, replace(RNN, z_factor=2.0))


@pytest.mark.parametrize("value", [0.0, -1.0, 1e7, float("nan"), float("inf")])
def test_a_factor_that_weighs_nothing_or_all_is_refused(value):
    for config, name in ((LAYERS, "error_factor"), (RNN, "z_factor"), (RNN, "reward_factor"), (ENDING, "done_factor")):
        with pytest.raises(UsageError, match=r"1e-06.*1e\+06"):
            replace(config, **{name: value})
    with pytest.raises(UsageError):
        MDNRNNConfig(reward="none", reward_factor=2.0)


def test_a_model_has_as_many_actions_as_its_drives(tmp_path):
    write_encoded(tmp_path, [[1.0, 2.0]] * 2, actions=5)
    assert train_mdnrnn.fit_layers(RNN, tmp_path).actions == 5
    assert train_mdnrnn.fit_layers(RNN, tmp_path / "empty") == RNN


def test_the_scale_of_rewards_is_measured_once_and_kept_by_what_goes_on_from_it(trained, tmp_path):
    value, data, other = replace(RNN, reward="value", reward_scale=0.0), tmp_path / "data", tmp_path / "other"
    own = linked(trained, data, "vae.safetensors", "encoded") / train_mdnrnn.CHECKPOINT
    train_mdnrnn.train_mdnrnn(data, BRIEF, ignore, value)
    rewards = [np.load(path)["reward"] for path in sorted((trained / "encoded").glob("*.npz"))[1:]]  # one is held out
    scale = load_config(own, MDNRNNConfig).reward_scale
    assert scale == pytest.approx(np.std(np.concatenate(rewards)), rel=1e-5)
    train_mdnrnn.train_mdnrnn(data, replace(BRIEF, updates=3), ignore, value)  # it goes on under the same flags
    write_encoded(other, [[1.0, 2.0], [1.0, 2.0], [3.0, 2.0]])
    assert train_mdnrnn.fit_layers(value, other, own).reward_scale == scale
    assert train_mdnrnn.fit_layers(value, other).reward_scale == pytest.approx(np.std([1, 2, 3, 2]), rel=1e-5)
    assert train_mdnrnn.fit_layers(replace(value, reward="none"), other).reward_scale == 1
    write_encoded(tmp_path / "equal", [[1.0] * 3] * 3)
    assert train_mdnrnn.fit_layers(value, tmp_path / "equal").reward_scale == 1, "there is nothing to scale"


def test_an_error_counts_by_how_far_its_pixel_is_from_the_mean_picture():
    torch.manual_seed(0)
    model = VAE(replace(LAYERS, kl_tolerance=0.0))
    pictures, noise, mean = torch.rand(2, 3, 64, 64), torch.zeros(2, 4), torch.rand(3, 64, 64)
    found = model.loss(pictures, noise, PixelWeights(mean, deviation=0.25, factor=3.0))
    plain = model.loss(pictures, noise)
    squares = (model.decode(model.encode(pictures)[0]) - pictures).square()
    away = (pictures - mean).abs().mean(dim=1, keepdim=True)
    torch.testing.assert_close(found.weighted, ((1 + 3 * away / 0.25) * squares).sum() / 2 + found.divergence)
    assert found[1:] == plain[1:]  # what is reported stays comparable
    assert torch.equal(plain.weighted, plain.plain)


def test_a_training_with_weighted_pixels_resumes_to_the_bit_though_drives_were_added(trained, tmp_path):
    layers, learnt = replace(LAYERS, pixel_weight=3.0), []
    for name, first in (("whole", 4), ("stopped", 2)):
        folder = tmp_path / name
        write_drives(folder, episodes=6, steps=8)
        train_vae.train_vae(folder, replace(BRIEF, updates=first, validate_every=4), ignore, layers)
        measured = load_progress(folder / train_vae.CHECKPOINT)["pixels"]
        assert 0 < measured["deviation"] < 1
        train_vae.train_vae(folder, replace(BRIEF, updates=4, validate_every=4), ignore, layers)
        learnt.append(load_weights(folder / train_vae.CHECKPOINT))
    assert all(np.array_equal(learnt[0][name], learnt[1][name]) for name in learnt[0])
    write_drives(tmp_path / "stopped", episodes=9, steps=8)
    train_vae.train_vae(tmp_path / "stopped", replace(BRIEF, updates=5), ignore, layers)
    assert load_progress(tmp_path / "stopped" / train_vae.CHECKPOINT)["pixels"] == measured
    assert "pixels" not in load_progress(trained / train_vae.CHECKPOINT)


LOSING = MDNRNNConfig(latent=1, hidden=4, done=True, lost=3)


def drives(*rewards, ended=False):
    """Rollouts with these rewards, padded; `ended` says whether the last one ended."""
    length = max(map(len, rewards))
    reward, mask, done = (np.zeros((len(rewards), length), np.float32) for _ in range(3))
    for row, each in enumerate(rewards):
        reward[row, : len(each)], mask[row, : len(each)] = each, 1
    done[-1, len(rewards[-1]) - 1] = ended
    latents, actions = np.zeros((len(rewards), length, 1), np.float32), np.zeros((len(rewards), length, 3), np.float32)
    return Rollouts(*map(torch.from_numpy, (latents, latents, actions, reward, done, mask)))


@pytest.mark.parametrize(
    ("rewards", "lost"),
    [
        ([1, 1, 1, 1, 1, 1], "000000"),
        ([1, -1, -1, -1, 1, 1], "100000"),  # three steps without reward follow the first one
        ([1, -1, -1, 1, 1, 1], "000000"),
        ([1, -1, -1, -1, -1, 1, 1], "1100000"),
        ([1, 1, -1, -1, -1], "00000"),  # whether it came back was not seen
        ([1, 1, -1, -1, -1, -1], "011111"),  # given up
        ([-1, -1, -1, -1], "1111"),  # it never moved
        ([-1, -1, -1, 1], "0000"),
    ],
)
def test_a_step_is_lost_where_no_reward_follows_for_so_long(rewards, lost):
    found = done_labels(LOSING, drives(rewards))
    assert "".join(str(int(each)) for each in found[0]) == lost


def test_padding_is_no_loss_and_changes_none():
    short, long = [1.0, -1, -1, -1, -1], [1.0] * 12
    found = done_labels(LOSING, drives(short, long))
    assert (found[0, :5] == done_labels(LOSING, drives(short))[0]).all()
    assert not found[0, 5:].any()
    assert not found[1].any()


def test_where_an_episode_ended_it_ends_too():
    assert done_labels(LOSING, drives([1.0] * 5, ended=True))[0].tolist() == [0, 0, 0, 0, 1]
    plain = replace(LOSING, lost=0)
    assert done_labels(plain, drives([1.0, -1, -1, -1, -1, -1], ended=True))[0].tolist() == [0, 0, 0, 0, 0, 1]


@pytest.mark.parametrize("values", [{"lost": -1}, {"lost": 5, "done": False}])
def test_steps_of_a_loss_need_a_done_head(values):
    with pytest.raises(UsageError):
        replace(LOSING, **values)


@pytest.mark.parametrize("weight", [1.0, 3.0, 10.0])
def test_a_weighted_head_learns_odds_that_are_so_much_too_high_until_they_are_calibrated(weight):
    labels = torch.zeros(1, 1000)
    labels[0, :50] = 1
    logit = torch.zeros(1, requires_grad=True)
    optimiser = torch.optim.LBFGS([logit], max_iter=100)

    def loss():
        optimiser.zero_grad()
        value = binary_loss(logit.expand(1, 1000), labels, torch.ones(1, 1000), weight)
        value.backward()
        return value

    optimiser.step(loss)
    learnt = torch.sigmoid(logit).item()
    assert learnt / (1 - learnt) == pytest.approx(weight * 0.05 / 0.95, rel=1e-3)
    assert calibrate_end(learnt, weight) == pytest.approx(0.05, rel=1e-3)


def test_certain_ends_stay_certain_and_without_a_weight_no_bit_changes():
    found = np.random.default_rng(0).random(1000, np.float32)
    assert calibrate_end(found, 1.0) is found
    assert calibrate_end(np.array([0, 1], np.float32), 7.0).tolist() == [0, 1]
    assert calibrate_end(found, 7.0).dtype == np.float32


@pytest.mark.parametrize("weight", [1.0, 4.0])
def test_the_quality_of_ends_is_of_calibrated_probabilities(tmp_path, weight):
    model = MDNRNN(MDNRNNConfig(latent=1, hidden=4, reward="none", done=True, done_weight=weight))
    with torch.no_grad():  # it predicts an end with probability 0.2 at every step
        model.heads.weight.zero_()
        model.heads.bias.fill_(np.log(weight * 0.2 / 0.8))
    figures = end_quality(model, write_encoded(tmp_path, np.zeros((45, 10)), latent=1, ended=True))
    assert figures == pytest.approx({"done_brier": 0.1 * 0.8**2 + 0.9 * 0.2**2, "done_calibration": 2})
    assert end_quality(MDNRNN(replace(model.config, done=False, done_weight=1)), []) == {}
