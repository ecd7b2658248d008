"""Tests torch_batch.py and torch_dream_step.py."""

import os
import sys

import numpy as np
import pytest

from dreamfleet import Scorer, UsageError, find_bundle
from dreamfleet.worker.addons.torch_dreams.torch_batch import ROWS, TorchDreamBatch
from dreamfleet.worker.addons.torch_dreams.torch_dream_step import TorchDreamStep
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.scoring.host_class_probe import HostClassProbe
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.dreams import dreams_of, spec_of
from tests.support.variants import VARIANTS
from tests.support.watching import Watching

DEVICE = os.environ.get("DREAMFLEET_TEST_TORCH_DEVICE", "cpu")
HORIZON = 70  # more than one block of steps
SMALL = {"latent": 3, "hidden": 4}
KINDS = {
    "dropout and previous reward": {"dropout": 0.2, "previous_reward": True},
    "attention and ends": {"window": 3, "attention_units": 5, "done": True},
    "joint mixtures": {"joint": True},
    "joint mixtures of columns": {"joint": True, "columns": 1},
    "value": {"reward": "value", "previous_reward": True},
}


def spec(bundle, **changes):
    return spec_of(bundle, **{"horizon": HORIZON, "temperature": 1.3, **changes})


def check(bundle, **changes):
    """The torch dream of a bundle is that of ONNX Runtime but for its last bits, and the same bits alone."""
    asked = spec(bundle, **changes)
    batch, episodes = TorchDreamBatch(bundle, asked, DEVICE), dreams_of(bundle, 3, range(3))
    found, wanted = batch.score(episodes), DreamBatch(bundle, asked).score(episodes)
    assert [score.steps for score in found] == [score.steps for score in wanted]
    np.testing.assert_allclose([s.fitness for s in found], [s.fitness for s in wanted], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose([s.measures for s in found], [s.measures for s in wanted], rtol=1e-3, atol=1e-3)
    assert batch.score(episodes[4:5]) == found[4:5]
    assert batch.score(episodes[::-1])[::-1] == found
    return found


def test_in_any_world_torch_dreams_what_onnx_runtime_does(world_bundle):
    check(world_bundle)
    check(world_bundle, recorded=1.0)


@pytest.mark.parametrize("kind", KINDS)
def test_any_kind_of_model_dreams_in_torch(tmp_path, kind):
    check(write_random_bundle(tmp_path / "b.zip", vae=VAEConfig(latent=3), rnn=MDNRNNConfig(**SMALL, **KINDS[kind])))


@pytest.mark.parametrize("name", ["all", "linear", "discrete"])
def test_any_variant_dreams_in_torch_and_is_measured(random_bundle, name):
    bundle = random_bundle.with_controllers(None, VARIANTS[name])
    found = check(bundle, measures=("steps", "gas", "brake.share"))
    assert len(set(found[0].measures)) == 3


def test_more_dreams_than_rows_are_dreamt_in_turn_and_an_invalid_vector_is_refused(random_bundle):
    batch = TorchDreamBatch(random_bundle, spec(random_bundle, horizon=2), DEVICE)
    few, done = dreams_of(random_bundle, 4, range(2)), []
    assert batch.score(few * (ROWS // 8 + 1), done.append) == batch.score(few) * (ROWS // 8 + 1)
    assert done == [2 * ROWS, 2 * ROWS + 16]
    for wrong in (np.zeros(3, np.float32), np.full_like(few[0][0], np.nan)):
        with pytest.raises(UsageError):
            batch.score([(wrong, 1)])


def test_a_watched_dream_has_the_same_score_and_shows_each_step_that_is_due(random_bundle):
    seen, plain, episodes = Watching(), Watching(), dreams_of(random_bundle, 3, range(3))
    batch = TorchDreamBatch(random_bundle, spec(random_bundle), DEVICE)
    assert batch.watched(seen).score(episodes) == batch.score(episodes)
    assert [(episode, snapshot.step) for episode, snapshot in seen] == [(0, step) for step in range(HORIZON)]
    DreamBatch(random_bundle, spec(random_bundle)).watched(plain).score(episodes)
    for _, snapshot in seen:
        for name in ("score", "action", "latent", "state"):
            mine, theirs = (getattr(each, name) for each in (snapshot, plain[snapshot.step][1]))
            np.testing.assert_allclose(mine, theirs, atol=1e-3)


def test_a_scorer_on_a_torch_device_is_of_a_class_of_its_own_also_where_the_probe_fails(random_bundle, monkeypatch):
    asked, (vector, seed) = spec(random_bundle), dreams_of(random_bundle, 3, range(3))[0]
    own, plain = Scorer(asked, random_bundle, DEVICE), Scorer(asked, random_bundle)
    assert own.host_class != plain.host_class
    assert Scorer(asked, random_bundle, DEVICE).host_class == own.host_class
    assert [own.score("score", vector, seed)] == TorchDreamBatch(random_bundle, asked, DEVICE).score([(vector, seed)])
    driven = asked.with_overrides(driven=True, horizon=5)
    assert own.score("score", vector, seed, spec=driven) == plain.score("score", vector, seed, spec=driven)
    monkeypatch.setattr(HostClassProbe, "add_batch", lambda *_given: 1 / 0)
    assert Scorer(asked, random_bundle, DEVICE).host_class != Scorer(asked, random_bundle).host_class


def test_what_survives_is_of_another_class_too_if_its_latents_are_others(choices_bundle, monkeypatch):
    """Its fitness is a number of steps, in which no last bit shows."""
    before = Scorer(spec(choices_bundle), choices_bundle, DEVICE).host_class
    sample = TorchDreamStep._sample
    monkeypatch.setattr(TorchDreamStep, "_sample", lambda *given: sample(*given) * (1 + 2**-20))
    assert Scorer(spec(choices_bundle), choices_bundle, DEVICE).host_class != before


@pytest.mark.parametrize("name", ["cuda:99", "sun", "meta"])
def test_a_device_that_is_not_there_is_an_error_and_so_is_one_without_torch(random_bundle, monkeypatch, name):
    with pytest.raises(UsageError, match=f"'{name}'"):
        Scorer(spec(random_bundle), random_bundle, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "dreamfleet.worker.addons.torch_dreams.torch_batch")
    with pytest.raises(UsageError):
        Scorer(spec(random_bundle), random_bundle, name)


def test_a_world_model_of_eight_bits_does_not_dream_in_torch():
    bundle = find_bundle("tiny-int8")
    with pytest.raises(UsageError, match=find_bundle("tiny").sha256[:12]):
        TorchDreamBatch(bundle, spec(bundle), DEVICE)
