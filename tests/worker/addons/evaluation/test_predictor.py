"""`Controller.predict` acts as the controller's policy does, from any state that it returned.
Tests dreamfleet/experiments/controllers.py."""

import pickle
import subprocess
import sys
from copy import deepcopy

import numpy as np
import pytest

from dreamfleet import Controller, ControllerShape, find_controller, make_environment, make_policy
from dreamfleet.common.errors import BundleError, ControllerError
from tests.support.processes import DEADLINE, environment
from tests.support.variants import controller_of

POLE = Controller(ControllerShape(4, 2), np.arange(10, dtype=np.float32), "gym:CartPole-v1", "")
PICTURES = np.random.default_rng(1).integers(0, 256, (6, 64, 64, 3), dtype=np.uint8)


def test_it_acts_as_the_policy_does_in_an_episode():
    controller = find_controller("tiny")
    policy, drive = make_policy(controller), make_environment(controller)
    observation, _ = drive.reset(seed=5)
    state = reward = None
    for _ in range(12):
        action, state = controller.predict(observation, state, reward=reward)
        assert np.array_equal(action, policy.act(observation))
        observation, reward, *_ = drive.step(action)
        policy.reward(reward)
    drive.close()


def test_a_state_is_a_value_that_can_be_used_again():
    controller = find_controller("tiny")
    states, actions = [None], []
    for picture in PICTURES:
        action, state = controller.predict(picture, states[-1])
        states.append(state)
        actions.append(action)
    for number in (4, 1, 0, 5):  # in any order
        kept = deepcopy(states[number])
        action, state = controller.predict(PICTURES[number], kept)
        assert np.array_equal(action, actions[number])
        assert np.array_equal(state, states[number + 1])
        assert number == 0 or np.array_equal(kept, states[number])
    begun, _ = controller.predict(PICTURES[0], states[4], episode_start=True)
    assert np.array_equal(begun, actions[0])


def test_without_a_world_model_it_has_no_state_and_it_can_be_copied_and_pickled_afterwards():
    assert POLE.predict(np.array([1, 0, 0, 0]), deterministic=True) == (1, None)
    for other in (pickle.loads(pickle.dumps(POLE)), deepcopy(POLE)):
        assert other.predict(np.ones(4)) == POLE.predict(np.ones(4))


def test_the_state_of_another_controller_is_refused():
    with pytest.raises(ControllerError, match=r"\(3,\) .*\(1, 512\)"):
        find_controller("tiny").predict(PICTURES[0], np.zeros(3))
    with pytest.raises(ControllerError):
        POLE.predict(np.ones(4), np.zeros((1, 512)))


def test_its_world_model_may_be_given(random_bundle):
    controller = controller_of(random_bundle)
    with pytest.raises(BundleError):
        controller.predict(PICTURES[0])
    action, _ = controller.predict(PICTURES[0], bundle=random_bundle)
    assert action.shape == (3,)


def test_without_the_packages_of_a_worker_the_error_names_what_to_install(tmp_path):
    POLE.save(tmp_path / "pole.npz")
    program = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "from pathlib import Path; from dreamfleet import Controller\n"
        f"Controller.load(Path({str(tmp_path / 'pole.npz')!r})).predict([0, 0, 0, 0])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment(tmp_path), capture_output=True, text=True, check=False,
        timeout=DEADLINE,
    )  # fmt: skip
    assert "'dreamfleet[worker]'" in done.stderr
