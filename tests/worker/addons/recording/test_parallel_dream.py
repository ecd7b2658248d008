import numpy as np
import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.recording.parallel_dream import ParallelDream, ParallelDreamConfig
from dreamfleet.worker.worldmodel.inference import DreamStep


def drive(bundle, steps, every, moved=0.0):
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
    real, dreamt, since = drive(random_bundle, 10, every=4)
    assert since == [0, 0, 0, 0, 4, 4, 4, 4, 8, 8]
    same = [np.array_equal(one, other) for one, other in zip(real, dreamt, strict=True)]
    assert [step for step, equal in enumerate(same) if equal] == [0, 4, 8]


def test_between_restarts_a_dream_does_not_depend_on_the_drive(random_bundle):
    real, dreamt, _ = drive(random_bundle, 6, every=100)
    other, again, _ = drive(random_bundle, 6, every=100, moved=1.0)
    assert np.array_equal(real[0], other[0])
    assert not np.array_equal(real[1:], other[1:])
    assert np.array_equal(dreamt, again)


@pytest.mark.parametrize("temperature", [0.0, float("nan")])
def test_an_invalid_temperature_is_refused(temperature):
    with pytest.raises(UsageError):
        ParallelDreamConfig(temperature)
