"""Drives under disturbed actions. Tests actors.py and worker/worldmodel/recurrent_state.py."""

import numpy as np
import pytest

from dreamfleet import find_bundle, find_controller
from dreamfleet.common.artifacts.actions import FIVE_CHOICES, STEERING_GAS_BRAKE, one_hot
from dreamfleet.worker.scoring.actors import ControllerActor
from dreamfleet.worker.scoring.disturbance import (
    ActionBursts,
    Disturbance,
    DisturbedPolicy,
    add_disturbance,
    numbered_choices,
)
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState


def test_noise_has_its_size_and_leaves_actions_at_a_bound_alone():
    disturbance = Disturbance(0, STEERING_GAS_BRAKE, 0.3)
    pushes = np.concatenate([disturbance.next() for _ in range(20_000)])
    np.testing.assert_allclose(pushes.std(axis=0), [0.3, 0.15, 0.15], rtol=0.1)
    chosen = np.array([[0.9, 0.0, 1.0], [0.0, 0.5, 0.2]], np.float32)
    done = add_disturbance(STEERING_GAS_BRAKE, chosen, np.array([[0.3, 0.3, -0.3]], np.float32))
    np.testing.assert_allclose(done, [[1.0, 0.0, 1.0], [0.3, 0.8, 0.0]], atol=1e-6)


def test_a_burst_replaces_a_resting_action_for_some_steps():
    chosen = np.array([[0.2, 1.0, 0.0]], np.float32)  # steers, full gas, no brake

    def drive(seed):
        bursts = ActionBursts(seed, STEERING_GAS_BRAKE, 0.02)
        return np.concatenate([bursts.apply(chosen, chosen) for _ in range(5000)])

    done = drive(4)
    assert (done[:, 0] == chosen[0, 0]).all()
    for action, resting in ((1, 1.0), (2, 0.0)):
        tried = done[:, action] != resting
        assert 0.1 < tried.mean() < 0.2  # 9 steps of every 50 + 9
        changes = np.flatnonzero(np.diff(done[:, action])) + 1
        lengths = np.diff(changes)[tried[changes[:-1]]]
        assert lengths.min() >= 3
        assert np.median(lengths) <= 12
        assert done[tried, action].std() > 0.2
    assert np.array_equal(done, drive(4))
    assert not np.array_equal(done, drive(5))
    assert (ActionBursts(0, STEERING_GAS_BRAKE, 0.0).apply(chosen, chosen) == chosen).all()


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0, 5.0])
def test_of_choices_the_noise_is_the_share_of_steps_with_another(noise):
    actions, chosen = one_hot(3), np.array([[1, 0, 0]], np.float32)
    one, other = (Disturbance(4, actions, noise) for _ in range(2))
    pushes = np.concatenate([one.next() for _ in range(20_000)])
    assert np.array_equal(pushes, np.concatenate([other.next() for _ in range(20_000)]))
    assert pushes.any(axis=1).mean() == pytest.approx(min(noise, 1), abs=0.03)
    assert {tuple(each) for each in pushes.tolist()} <= {(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)}
    done = np.concatenate([one.apply(chosen, push[None]) for push in pushes])
    assert (done.sum(axis=1) == 1).all(), "never a mixture of choices"
    assert np.array_equal(done[~pushes.any(axis=1)], np.repeat(chosen, (~pushes.any(axis=1)).sum(), axis=0))


def test_a_push_of_choices_is_held_and_a_burst_is_one():
    chosen = np.array([[1, 0, 0]], np.float32)
    bursts = ActionBursts(0, one_hot(3), 0.02)
    done = np.concatenate([bursts.apply(chosen, chosen) for _ in range(5000)])
    tried = done[:, 0] == 0
    assert 0.05 < tried.mean() < 0.2
    changes = np.flatnonzero(np.diff(done.argmax(axis=1))) + 1
    assert np.diff(changes)[tried[changes[:-1]]].min() >= 3
    assert (done.sum(axis=1) == 1).all()


def test_choices_of_numbers_are_disturbed_as_numbers():
    assert not len(numbered_choices(FIVE_CHOICES)), "the car takes every steering between its choices"
    assert not len(numbered_choices(STEERING_GAS_BRAKE))
    assert len(numbered_choices(one_hot(3))) == 3


class Recorder(DisturbedPolicy):
    def on_action(self, action, push):
        self.noted = (*getattr(self, "noted", ()), (action, push))


@pytest.fixture(scope="module")
def tiny():
    return find_bundle("tiny")


def driver(tiny, noise, watching=None):
    mind, controller = RecurrentState(tiny), find_controller("tiny")
    return mind, Recorder(ControllerActor(controller, tiny, mind), Disturbance(3, STEERING_GAS_BRAKE, noise), watching)


def pictures(count):
    return np.random.default_rng(0).integers(0, 255, (count, 64, 64, 3), dtype=np.uint8)


def test_every_recurrent_state_gets_the_disturbed_action(tiny):
    watching, calm = RecurrentState(tiny), RecurrentState(tiny)
    mind, policy = driver(tiny, 0.5, watching)
    for picture in pictures(5):
        done = policy.act(picture)
        calm.see(picture)
        calm.advance(done[None])
    assert np.array_equal(mind.state, calm.state)
    assert np.array_equal(watching.state, calm.state)
    assert all(np.abs(push).max() > 0 for _, push in policy.noted)
    policy.begin()
    assert not mind.state.any()
    assert not watching.state.any()


def test_without_noise_it_does_what_the_actor_chooses(tiny):
    mind, policy = driver(tiny, 0.0)
    hand = ControllerActor(find_controller("tiny"), tiny, mind)
    for picture in pictures(3):
        policy.begin()
        done = policy.act(picture)
        policy.begin()
        mind.see(picture)
        assert np.array_equal(hand.choose(None)[0], done)
