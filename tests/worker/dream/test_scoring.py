"""Tests batch.py and task.py."""

import numpy as np
import pytest

from dreamfleet import Scorer, UsageError
from dreamfleet.common.artifacts.world_facts import EndRule
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.dream.environment import Dream
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import EpisodeConfig
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.dreams import DreamPolicy, dreams_of, same_bits, spec_of
from tests.support.variants import VARIANTS

HORIZON = 20


def spec(bundle, **changes):
    return spec_of(bundle, **{"horizon": HORIZON, "temperature": 1.3, **changes})


def test_a_fitness_is_the_same_bits_alone_in_any_batch_in_any_order_and_by_an_episode(random_bundle):
    dreams = dreams_of(random_bundle, 20, (1, 2, 3))
    found = same_bits(random_bundle, spec(random_bundle), dreams)
    assert len({score.fitness for score in found}) == len(dreams)
    environment, (vector, seed) = Dream(random_bundle, temperature=1.3, horizon=HORIZON), dreams[-1]
    driven = episode.score(environment, DreamPolicy(random_bundle), vector, EpisodeConfig(seed, HORIZON))
    assert driven == found[-1]


def test_a_run_dreams_in_a_described_world_and_its_host_class_is_of_the_drawn_ends_too(choices_bundle, monkeypatch):
    asked = spec(choices_bundle, horizon=100)
    scorer = Scorer(asked, choices_bundle)
    assert Scorer(asked, choices_bundle).host_class == scorer.host_class
    for vector, seed in dreams_of(choices_bundle, 2, (3,)):
        score = scorer.score("score", vector, seed=seed)
        assert [score] == DreamBatch(choices_bundle, asked).score([(vector, seed)])
        assert 1 < score.steps < 100
    bars = EndRule.bars
    monkeypatch.setattr(EndRule, "bars", lambda *given, **named: bars(*given, **named) * np.float32(0.2))
    assert Scorer(asked, choices_bundle).host_class != scorer.host_class


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_dreams_the_same_bits_too(random_bundle, name):
    bundle = random_bundle.with_controllers(None, VARIANTS[name])
    dreams = dreams_of(bundle, 9, (1, 2))
    assert len({score.fitness for score in same_bits(bundle, spec(bundle), dreams)}) == len(dreams)


def test_rows_that_end_do_not_change_the_others(tmp_path):
    rnn = MDNRNNConfig(latent=3, hidden=4, done=True)
    plain = write_random_bundle(tmp_path / "b.zip", 5, VAEConfig(latent=3, channels=(2, 2, 2, 2)), rnn)
    bundle = plain.with_controllers(None, VARIANTS["all"])
    found = same_bits(bundle, spec(bundle, temperature=3.0), dreams_of(bundle, 20, range(3)))
    assert len({score.steps for score in found}) > 2


def test_steps_are_reported_as_they_are_made_and_an_invalid_vector_is_refused(random_bundle):
    dreaming, reported = DreamBatch(random_bundle, spec(random_bundle)), []
    dreams = dreams_of(random_bundle, 3, (1,))
    dreaming.score(dreams, reported.append)
    assert reported == [3 * step for step in range(1, HORIZON + 1)]
    (vector, _), *_ = dreams
    vector[3] = np.nan
    for wrong in (vector, vector[:-1]):
        with pytest.raises(UsageError):
            dreaming.score([(wrong, 1)])
