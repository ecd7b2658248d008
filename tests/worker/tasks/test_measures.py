"""Measures of an episode beside its fitness, in reality and in a dream. Tests common/protocol/measures.py."""

import dataclasses

import numpy as np
import pytest

from dreamfleet import Continuous, ControllerShape, Discrete, Scorer, TaskSpec, UsageError, find_bundle, find_controller
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.tasks.measures import Measurer

CAR = ("gas", "steer.abs", "brake.share", "steps")


def pole(*measures):
    return TaskSpec("gym:CartPole-v1", "", 30, 0, controller=ControllerShape(4, 2), measures=measures)


def score(spec, parameters, bundle=None):
    return Scorer(spec, bundle).score("score", parameters, 1)


def test_a_numbered_action_is_measured_by_the_share_of_its_steps_which_changes_no_fitness():
    parameters = np.random.default_rng(1).normal(0, 1, 10).astype(np.float32)
    plain, found = score(pole(), parameters), score(pole("steps", "action0", "action1", "action1.share"), parameters)
    steps, left, right, share = found.measures
    assert steps == found.steps
    assert left + right == pytest.approx(1)
    assert 0 < right == share < 1
    assert (plain.fitness, plain.steps, plain.measures) == (found.fitness, found.steps, ())


@pytest.mark.parametrize(
    ("name", "named"), [("speed", "'speed'.* steps, action0, action0.abs"), ("truth.speed", "'truth.speed'")]
)
def test_a_measure_that_the_world_or_the_dream_lacks_is_refused(name, named):
    with pytest.raises(UsageError, match=named):
        Scorer(pole(name))
    bundle = find_bundle("tiny")
    with pytest.raises(UsageError, match=name):
        DreamBatch(bundle, TaskSpec("dream", bundle.sha256, 40, 0, measures=(name,)))


def test_a_number_that_the_last_info_lacks_is_the_episodes_failure():
    with pytest.raises(ValueError, match="'goal'"):
        score(pole("info.goal"), np.zeros(10, np.float32))


def test_a_cars_speed_is_its_true_states_mean():
    bundle = find_bundle("tiny")
    spec = TaskSpec("car-racing", bundle.sha256, 60, 0, measures=("truth.speed", "gas", "brake.share"))
    speed, gas, braking = score(spec, find_controller("tiny").parameters, bundle).measures
    assert 1 < speed < 100
    assert 0 < gas < 1
    assert 0 <= braking < 1


def test_a_dreams_measures_are_the_same_bits_in_any_batch():
    bundle, controller = find_bundle("tiny"), find_controller("tiny")
    spec = TaskSpec("dream", bundle.sha256, 40, 0, temperature=1.3)
    noise = np.random.default_rng(4).normal(0, 0.3, (6, len(controller.parameters)))
    dreams = [((controller.parameters + each).astype(np.float32), seed) for each in noise for seed in (1, 2)]
    measuring = DreamBatch(bundle, dataclasses.replace(spec, measures=CAR))
    together = measuring.score(dreams)
    assert len({each.measures for each in together}) == len(dreams)
    assert measuring.score(dreams[::-1])[::-1] == together
    assert [measuring.score([each])[0] for each in dreams] == together
    assert [each.fitness for each in together] == [each.fitness for each in DreamBatch(bundle, spec).score(dreams)]
    assert all(0 <= each.measures[0] <= 1 and each.measures[3] == each.steps for each in together)


def test_a_tally_counts_each_row_alone():
    measurer = Measurer(("gas", "gas.abs", "gas.share"), Continuous.between([-1, -1], [1, 1]), ("gas", "brake"))
    tally = measurer.begin(3)
    tally.add(np.array([0, 2]), np.array([[0.5, 0], [-1, 0]], np.float32))
    tally.add(np.array([2]), np.array([[1, 0]], np.float32))
    assert measurer.values(tally, 0, 1) == (0.5, 0.5, 1.0)
    assert measurer.values(tally, 2, 2) == (0.0, 1.0, 0.5)
    numbered = Measurer(("action1",), Discrete(2, first=5), ())
    tally = numbered.begin(1)
    for action in (6, 5, 6, 6):
        tally.add(np.array([0]), np.array([action]))
    assert numbered.values(tally, 0, 4) == (0.75,)
