"""Tests world.py."""

import dataclasses

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import write_bundle
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.errors import BundleError
from dreamfleet.worker.addons.recording.parallel_dream import DreamContinuation, ParallelDream, ParallelDreamConfig
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.dream.noise import EpisodeNoise
from dreamfleet.worker.dream.world import DreamEnds, DreamWorld
from dreamfleet.worker.worldmodel.inference import DreamStep
from tests.support.dreams import spec_of, with_end, write_bundle_of

DREAMS, HORIZON = 2000, 200


def lengths(bundle, temperature):
    """The lengths of many dreams of one controller, and what they earned."""
    parameters = np.zeros(bundle.controller_shape.size, np.float32)
    dreams = DreamBatch(bundle, spec_of(bundle, HORIZON, temperature=temperature))
    scores = dreams.score([(parameters, seed) for seed in range(DREAMS)])
    return np.array([score.steps for score in scores]), np.array([score.fitness for score in scores])


@pytest.mark.parametrize(("temperature", "share"), [(1.0, 0.2), (2.0, 1 / 3)])
@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_dreams_end_as_often_as_predicted_under_the_temperature(choices_bundle, tmp_path, temperature, share, weight):
    predicted = weight * 0.2 / (weight * 0.2 + 0.8)  # of a chance of 0.2, by a model with so much heavier ends
    rule = EndRule("drawn", odds_weight=weight)
    steps, earned = lengths(with_end(choices_bundle, tmp_path / "b.zip", predicted, end=rule), temperature)
    assert steps.max() < HORIZON
    assert len(steps) / steps.sum() == pytest.approx(share, abs=0.01)
    assert np.array_equal(earned, 4.0 * (steps - 1)), "the step that ends a dream is not survived"


@pytest.mark.parametrize(("at", "steps"), [(0.19, 1), (0.21, HORIZON)])
def test_a_threshold_is_the_same_at_every_step_and_temperature(choices_bundle, tmp_path, at, steps):
    bundle = with_end(choices_bundle, tmp_path / "b.zip", 0.2, end=EndRule(at=at))
    for temperature in (0.5, 2.0):
        assert set(lengths(bundle, temperature)[0]) == {steps}
    assert DreamWorld(bundle, 1.0).bars is None


def test_a_rule_in_place_of_the_bundles_keeps_the_weight_of_its_odds(choices_bundle, random_bundle):
    own = choices_bundle.manifest.world.end
    assert DreamEnds(choices_bundle, 1.0).rule == own
    assert DreamEnds(choices_bundle, 1.0, "drawn").rule == own
    assert DreamEnds(choices_bundle, 1.0, "0.25").rule == EndRule(at=0.25, odds_weight=own.odds_weight)
    without_facts = DreamEnds(random_bundle, 1.0)
    assert (without_facts.rule, without_facts.bars) == (EndRule("threshold", 0.5), None)


def test_dreams_beside_a_drive_and_from_a_moment_end_by_the_rule_too(choices_bundle, tmp_path):
    bundle = with_end(choices_bundle, tmp_path / "b.zip", 0.2, end=EndRule("drawn"))
    model, parameters = DreamStep(bundle), np.zeros(bundle.controller_shape.size, np.float32)
    latent, state = np.zeros(model.latent_size, np.float32), model.zero_state(1)
    beside = ParallelDream(bundle, parameters, ParallelDreamConfig(every=1000, seed=5))
    begun = []
    for step in range(2000):
        beside.follow(step, latent[None], state)
        begun.append(beside.since)
    assert len(set(begun)) == pytest.approx(400, abs=40)
    continued = DreamContinuation(bundle, 1.0)
    found = [
        len(list(continued.dream(latent, state[0], parameters, continued.make_noise(seed)))) for seed in range(400)
    ]
    assert np.mean(found) == pytest.approx(4, abs=0.7)  # those before the end


def step_of(bundle):
    """One dreamt step of one seed, and the reward head's output there."""
    world, model = DreamWorld(bundle, 1.0), DreamStep(bundle)
    draw = EpisodeNoise(3, world.chance, world.bars).next()
    latent, action = np.zeros((1, 3), np.float32), np.ones((1, bundle.manifest.actions), np.float32)
    head = model.imagine(latent, action, model.zero_state(1), draw.uniform, draw.normal, 1.0).reward
    return world.imagine(latent, action, world.begin(1), draw), float(head[0])


def test_a_predicted_value_has_the_scale_of_the_recorded_rewards(tmp_path):
    plain = write_bundle_of("one number", tmp_path / "a.zip")
    manifest, parts = plain.manifest, {name: plain.read(name) for name in plain.manifest.parts}
    models = {**manifest.models, "mdnrnn": {**manifest.models["mdnrnn"], "reward_scale": 8.0}}
    facts = dataclasses.replace(manifest.world, reward=RewardFacts("value", gain=0.5, cost=0.25))
    scaled = write_bundle(tmp_path / "b.zip", dataclasses.replace(manifest, models=models, world=facts), parts)
    moment, head = step_of(plain)
    assert moment.reward[0] == head != 0
    assert step_of(scaled)[0].reward[0] == 0.5 * 8 * head - 0.25


def test_a_reward_that_the_model_does_not_predict_is_refused(tmp_path):
    for world, source in (("one number", "label"), ("choices", "value"), ("choices", "label")):
        bundle = write_bundle_of(world, tmp_path / "b.zip")
        wrong = with_end(bundle, tmp_path / "wrong.zip", 0.5, reward=RewardFacts(source))
        with pytest.raises(BundleError):
            DreamWorld(wrong, 1.0)
