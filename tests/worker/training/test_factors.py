"""Factors weight the parts of a loss; reported losses are unweighted.
Tests worker/worldmodel/config_fields.py."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.checkpoint import load_config, load_progress, load_weights
from dreamfleet.worker.training.data.rollouts import load_rollouts
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
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


def test_a_factor_changes_what_is_learnt_and_held_out_losses_stay_comparable(trained, tmp_path):
    layers, reported, learnt = replace(LAYERS, loss="notebook"), [], []
    for factor in (1.0, 4.0):
        folder = linked(trained, tmp_path / f"{factor}", "episodes")
        still = replace(SHORT, updates=1, rate=1e-12)
        train_vae.train_vae(folder, still, ignore, replace(layers, error_factor=factor))
        reported.append(json.loads((folder / "vae.jsonl").read_text().splitlines()[-1]))
        train_vae.train_vae(folder, SHORT, ignore, replace(layers, error_factor=factor))
        learnt.append(load_weights(folder / train_vae.CHECKPOINT))
    assert reported[0] == pytest.approx(reported[1])
    assert list(reported[0]) == ["update", "held_out", "held_out_error", "held_out_kl"]
    assert not np.array_equal(learnt[0]["mu.weight"], learnt[1]["mu.weight"])


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
