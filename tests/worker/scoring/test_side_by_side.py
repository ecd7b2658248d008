"""Episodes that a slot drives side by side have the bits that they have alone. Tests worker/tasks/side_by_side.py."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from dreamfleet import find_controller
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.worldmodel.mdnrnn_config import REWARDED
from dreamfleet.worker.worlds.car_racing.task import CarRacingTask
from tests.support.bundles import write_random_bundle
from tests.support.variants import VARIANTS, vectors

SEEDS = range(2**20, 2**20 + 4)


def spec(bundle, **changes):
    return dataclasses.replace(TaskSpec("car-racing", bundle.sha256, horizon=60, patience=30), **changes)


def jobs(bundle):
    return [("score", each, seed) for each, seed in zip(vectors(bundle, len(SEEDS)), SEEDS, strict=True)]


def assert_equal_bits(bundle, asked=None):
    with_others, alone = Scorer(asked or spec(bundle), bundle), Scorer(asked or spec(bundle), bundle)
    found, steps = jobs(bundle), []
    together = with_others.score_all(found, steps.append)
    assert together == [alone.score(*each) for each in found]
    assert len({score.fitness for score in together}) == len(found)
    assert steps[-1] == sum(score.steps for score in together)
    assert with_others.score_all(found[::-1], steps.append) == together[::-1]
    assert with_others.score_all(found[1:3], steps.append) == together[1:3]
    for scorer in (with_others, alone):
        scorer.close()


@pytest.mark.parametrize("name", ["tiny-int8", "tiny"])
def test_a_score_has_the_same_bits_alone_and_side_by_side(name):
    bundle = find_bundle(name)
    assert_equal_bits(bundle, spec(bundle, horizon=120))


@pytest.mark.parametrize("name", [*VARIANTS, "prices"])
def test_a_variant_has_the_same_bits_alone_and_side_by_side(random_bundle, name):
    variant = VARIANTS.get(name, Variant(offroad_cost=0.5, time_cost=0.2))
    bundle = random_bundle.with_controllers(None, variant)
    assert_equal_bits(bundle, spec(bundle, options=variant.options, version=variant.version))


def test_a_model_that_takes_rewards_has_the_same_bits_alone_and_side_by_side(tmp_path):
    rnn = dataclasses.replace(REWARDED, previous_reward=True)
    assert_equal_bits(write_random_bundle(tmp_path / "rewarded.zip", rnn=rnn))


def test_every_episode_has_an_end_of_its_own():
    bundle = find_bundle("tiny-int8")
    scorer = Scorer(spec(bundle, horizon=200), bundle)
    still = np.zeros(bundle.controller_shape.size, np.float32)
    able = find_controller("tiny").parameters
    scores = scorer.score_all([("score", each, 2**20) for each in (still, able, still, able)], lambda _: None)
    assert scores[0].steps < scores[1].steps == 200
    assert scores[:2] == scores[2:]
    assert scores == [scorer.score("score", each, 2**20) for each in (still, able, still, able)]
    scorer.close()


def test_a_watched_group_is_driven_one_by_one():
    bundle = find_bundle("tiny-int8")
    asked = spec(bundle, horizon=10, patience=0)
    scorer = Scorer(asked, bundle)
    unwatched = scorer.score_all(jobs(bundle), lambda _: None)
    seen = []
    scorer.observer = SimpleNamespace(
        is_due=lambda: True, observe=lambda number, look: seen.append((number, look().step))
    )
    assert scorer.score_all(jobs(bundle), lambda _: None) == unwatched
    assert seen == [(number, step) for number in range(4) for step in range(10)]
    scorer.close()


def test_parameters_that_are_no_numbers_are_refused():
    bundle = find_bundle("tiny-int8")
    scorer = Scorer(spec(bundle), bundle)
    wrong = np.full(bundle.controller_shape.size, np.nan, np.float32)
    with pytest.raises(ValueError):
        scorer.score_all([*jobs(bundle)[:3], ("score", wrong, 1)], lambda _: None)
    scorer.close()


def test_the_drives_of_a_dreams_run_are_driven_side_by_side():
    bundle = find_bundle("tiny-int8")
    asked = TaskSpec("dream", bundle.sha256, horizon=60, patience=30, temperature=1.0)
    scorer = Scorer(asked, bundle)
    assert scorer.together == CarRacingTask.batch_size
    driven = asked.with_overrides(driven=True)
    together = scorer.score_all(jobs(bundle), lambda _: None, driven)
    assert together == [scorer.score(*each, spec=driven) for each in jobs(bundle)]
    real = Scorer(spec(bundle), bundle)
    assert together == real.score_all(jobs(bundle), lambda _: None)
    for each in (scorer, real):
        each.close()


def test_measured_episodes_are_driven_one_by_one():
    bundle = find_bundle("tiny-int8")
    scorer = Scorer(spec(bundle, measures=("gas",)), bundle)
    assert scorer.together == 1
    assert all(score.measures for score in scorer.score_all(jobs(bundle)[:2], lambda _: None))
    scorer.close()
