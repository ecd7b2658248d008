"""Factors weight the parts of a loss; reported losses are unweighted. Which steps count as ends.
Tests worker/worldmodel/config_fields.py and worker/training/data/rollout_batches.py."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.checkpoint import load_config, load_progress, load_weights
from dreamfleet.worker.training.data.rollout_batches import Rollouts, done_labels, load_rollouts
from dreamfleet.worker.training.prediction_quality import end_quality
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, binary_loss
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig, calibrate_end
from dreamfleet.worker.worldmodel.vae import VAE, PixelWeights
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.drives import ignore, linked, train_models, write_drives, write_encoded

LAYERS, RNN = VAEConfig(latent=4, channels=(4, 4, 8, 8)), MDNRNNConfig(latent=4, hidden=8, mixtures=2)
ENDING = replace(RNN, done=True)
SHORT = TrainConfig(updates=2, batch=8, rate=1e-3, validate_every=1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_drives(folder, episodes=4, steps=8)
    return train_models(folder, SHORT, LAYERS, RNN)


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
        train_vae.train_vae(trained, SHORT, ignore, replace(LAYERS, error_factor=4.0))
    with pytest.raises(DatasetError, match=r"z_factor.*1\.0.*2\.0"):
        train_mdnrnn.train_mdnrnn(trained, SHORT, ignore, replace(RNN, z_factor=2.0))


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
    train_mdnrnn.train_mdnrnn(data, SHORT, ignore, value)
    rewards = [np.load(path)["reward"] for path in sorted((trained / "encoded").glob("*.npz"))[1:]]  # one is held out
    scale = load_config(own, MDNRNNConfig).reward_scale
    assert scale == pytest.approx(np.std(np.concatenate(rewards)), rel=1e-5)
    train_mdnrnn.train_mdnrnn(data, replace(SHORT, updates=3), ignore, value)  # it goes on under the same flags
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
        train_vae.train_vae(folder, replace(SHORT, updates=first, validate_every=4), ignore, layers)
        measured = load_progress(folder / train_vae.CHECKPOINT)["pixels"]
        assert 0 < measured["deviation"] < 1
        train_vae.train_vae(folder, replace(SHORT, updates=4, validate_every=4), ignore, layers)
        learnt.append(load_weights(folder / train_vae.CHECKPOINT))
    assert all(np.array_equal(learnt[0][name], learnt[1][name]) for name in learnt[0])
    write_drives(tmp_path / "stopped", episodes=9, steps=8)
    train_vae.train_vae(tmp_path / "stopped", replace(SHORT, updates=5), ignore, layers)
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
