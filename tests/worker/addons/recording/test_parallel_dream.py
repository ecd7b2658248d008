import numpy as np
import pytest
import torch

from dreamfleet.common.artifacts.bundle import write_bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.recording.parallel_dream import ParallelDream, ParallelDreamConfig
from dreamfleet.worker.training.assemble import export_graphs, make_manifest
from dreamfleet.worker.worldmodel.inference import DreamStep
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.models import random_models, weights

TINY = VAEConfig(latent=3, channels=(2, 2, 2, 2))


def drive(bundle, steps, config=None, moved=0.0):
    """The latents of an artificial drive, the dreamt ones, and where each dream started."""
    random, model = np.random.default_rng(0), DreamStep(bundle)
    parameters = random.normal(size=bundle.controller_shape.size).astype(np.float32)
    daydream = ParallelDream(bundle, parameters, config or ParallelDreamConfig(every=4))
    real = random.normal(size=(steps, 1, model.latent_size)).astype(np.float32)
    real[1:] += np.float32(moved)
    states = random.normal(size=(steps, 1, model.state_size)).astype(np.float32)
    dreamt, since = [], []
    for step in range(steps):
        dreamt.append(daydream.follow(step, real[step], states[step]))
        since.append(daydream.since)
    return real, np.stack(dreamt), since


def test_a_dream_restarts_from_the_drives_latent(random_bundle):
    real, dreamt, since = drive(random_bundle, 10)
    assert since == [0, 0, 0, 0, 4, 4, 4, 4, 8, 8]
    same = [np.array_equal(one, other) for one, other in zip(real, dreamt, strict=True)]
    assert [step for step, equal in enumerate(same) if equal] == [0, 4, 8]


def test_between_restarts_a_dream_does_not_depend_on_the_drive(random_bundle):
    config = ParallelDreamConfig(every=100)
    real, dreamt, _ = drive(random_bundle, 6, config)
    other, again, _ = drive(random_bundle, 6, config, moved=1.0)
    assert np.array_equal(real[0], other[0])
    assert not np.array_equal(real[1:], other[1:])
    assert np.array_equal(dreamt, again)


def test_a_model_without_a_reward_head_dreams_too(tmp_path):
    rnn = MDNRNNConfig(latent=3, hidden=4, reward="none")
    _, dreamt, _ = drive(write_random_bundle(tmp_path / "b.zip", vae=TINY, rnn=rnn), 3)
    assert np.isfinite(dreamt).all()


def test_a_dream_that_has_ended_restarts(tmp_path):
    rnn = MDNRNNConfig(latent=3, hidden=4, done=True)
    vae, model = random_models(0, TINY, rnn)
    with torch.no_grad():
        model.heads.bias[-1] = 9.0  # always predicts the end
    parts = export_graphs(weights(vae), weights(model), np.zeros((1, 2, 3), np.float32), TINY, rnn)
    bundle = write_bundle(tmp_path / "b.zip", make_manifest("over", {}, TINY, rnn), parts)
    real, dreamt, since = drive(bundle, 3)
    assert since == [0, 1, 2]
    assert np.array_equal(real, dreamt)


@pytest.mark.parametrize("temperature", [0.0, float("nan")])
def test_an_invalid_temperature_is_refused(temperature):
    with pytest.raises(UsageError):
        ParallelDreamConfig(temperature)
