"""Tests batch.py and task.py."""

import dataclasses

import numpy as np
import pytest

from dreamfleet.common.artifacts.world_facts import EndRule
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.dream.environment import Dream, DreamPolicy
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import EpisodeConfig
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.variants import VARIANTS

HORIZON = 20


@pytest.fixture(scope="module")
def dreaming(random_bundle):
    return DreamBatch(random_bundle, spec(random_bundle))


def spec(bundle, **changes):
    return dataclasses.replace(TaskSpec("dream", bundle.sha256, HORIZON, 0, temperature=1.3), **changes)


def candidates(bundle, count):
    random = np.random.default_rng(4)
    return [random.normal(0, 0.3, bundle.controller_shape.size).astype(np.float32) for _ in range(count)]


def test_a_fitness_is_the_same_bits_alone_in_any_batch_and_in_any_order(dreaming, random_bundle):
    dreams = [(vector, seed) for vector in candidates(random_bundle, 20) for seed in (1, 2, 3)]
    together = dreaming.score(dreams)
    assert len({score.fitness for score in together}) == len(dreams)
    assert dreaming.score(dreams[::-1])[::-1] == together
    assert [dreaming.score([dream])[0] for dream in dreams[:7]] == together[:7]
    assert dreaming.score(dreams[11:16]) == together[11:16]


def test_in_any_world_a_fitness_is_the_same_bits_alone_in_any_batch_and_step_by_step(world_bundle):
    dreamer = DreamBatch(world_bundle, spec(world_bundle))
    dreams = [(vector, seed) for vector in candidates(world_bundle, 5) for seed in range(8)]
    together = dreamer.score(dreams)
    assert len(set(together)) > 4
    assert dreamer.score(dreams[::-1])[::-1] == together
    environment, policy = Dream(world_bundle, temperature=1.3, horizon=HORIZON), DreamPolicy(world_bundle)
    for (vector, seed), found in zip(dreams, together, strict=True):
        assert dreamer.score([(vector, seed)]) == [found]
        assert episode.score(environment, policy, vector, EpisodeConfig(seed, HORIZON)) == found


def test_a_run_dreams_in_a_described_world_and_its_host_class_is_of_the_drawn_ends_too(choices_bundle, monkeypatch):
    asked = spec(choices_bundle, horizon=100)
    scorer = Scorer(asked, choices_bundle)
    assert Scorer(asked, choices_bundle).host_class == scorer.host_class
    for vector in candidates(choices_bundle, 2):
        score = scorer.score("score", vector, seed=3)
        assert [score] == DreamBatch(choices_bundle, asked).score([(vector, 3)])
        assert 1 < score.steps < 100
    bars = EndRule.bars
    monkeypatch.setattr(EndRule, "bars", lambda *given, **named: bars(*given, **named) * np.float32(0.2))
    assert Scorer(asked, choices_bundle).host_class != scorer.host_class


def test_the_environment_dreams_the_same_bits(dreaming, random_bundle):
    environment = Dream(random_bundle, temperature=1.3, horizon=HORIZON)
    for vector, seed in zip(candidates(random_bundle, 3), (5, 6, 7), strict=True):
        (batched,) = dreaming.score([(vector, seed)])
        assert episode.score(environment, DreamPolicy(random_bundle), vector, EpisodeConfig(seed, HORIZON)) == batched


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_dreams_the_same_bits_alone_in_any_batch_and_step_by_step(random_bundle, name):
    bundle = random_bundle.with_controllers(None, VARIANTS[name])
    dreamer = DreamBatch(bundle, spec(bundle))
    dreams = [(vector, seed) for vector in candidates(bundle, 9) for seed in (1, 2)]
    together = dreamer.score(dreams)
    assert len({score.fitness for score in together}) == len(dreams)
    assert dreamer.score(dreams[::-1])[::-1] == together
    assert dreamer.score(dreams[5:12]) == together[5:12]
    environment = Dream(bundle, temperature=1.3, horizon=HORIZON)
    for dream, found in zip(dreams[:4], together[:4], strict=True):
        assert dreamer.score([dream]) == [found]
        assert episode.score(environment, DreamPolicy(bundle), dream[0], EpisodeConfig(dream[1], HORIZON)) == found


def test_rows_that_end_do_not_change_the_others(tmp_path):
    rnn = MDNRNNConfig(latent=3, hidden=4, done=True)
    plain = write_random_bundle(tmp_path / "b.zip", 5, VAEConfig(latent=3, channels=(2, 2, 2, 2)), rnn)
    bundle = plain.with_controllers(None, VARIANTS["all"])
    dreamer = DreamBatch(bundle, spec(bundle, temperature=3.0))
    dreams = [(vector, seed) for vector in candidates(bundle, 20) for seed in range(3)]
    together = dreamer.score(dreams)
    assert len({score.steps for score in together}) > 2
    assert [dreamer.score([dream])[0] for dream in dreams] == together


def test_with_dropout_scores_have_the_same_bits_too(tmp_path):
    bundle = write_random_bundle(tmp_path / "b.zip", rnn=MDNRNNConfig(dropout=0.3))
    dreamer, environment = DreamBatch(bundle, spec(bundle)), Dream(bundle, temperature=1.3, horizon=HORIZON)
    dreams = [(vector, seed) for vector in candidates(bundle, 3) for seed in (1, 2)]
    together = dreamer.score(dreams)
    assert [dreamer.score([dream])[0] for dream in dreams] == together
    assert [
        episode.score(environment, DreamPolicy(bundle), vector, EpisodeConfig(seed, HORIZON)) for vector, seed in dreams
    ] == together


def test_steps_are_reported_as_they_are_made(dreaming, random_bundle):
    reported = []
    dreaming.score([(vector, 1) for vector in candidates(random_bundle, 3)], reported.append)
    assert reported == [3 * step for step in range(1, HORIZON + 1)]


def test_another_temperature_is_another_dream(dreaming, random_bundle):
    dreams = [(candidates(random_bundle, 1)[0], 1)]
    colder = DreamBatch(random_bundle, spec(random_bundle, temperature=0.5))
    assert colder.score(dreams) != dreaming.score(dreams)


def test_an_invalid_vector_is_refused(dreaming, random_bundle):
    (vector,) = candidates(random_bundle, 1)
    vector[3] = np.nan
    for wrong in (vector, vector[:-1]):
        with pytest.raises(UsageError):
            dreaming.score([(wrong, 1)])
