import gymnasium
import numpy as np
import pytest

from common.bundle import Manifest, write_bundle
from common.errors import BundleError, ControllerError, UsageError
from tests.support import tasks
from worker.rollout import Course, rollout
from worker.tasks.api import find_task, known_tasks
from worker.tasks.preprocessing import picture


def test_car_racing_is_registered():
    assert "car-racing" in known_tasks()
    assert find_task("car-racing").name == "car-racing"


def test_a_task_is_found_by_its_reference():
    assert find_task(tasks.TOY).name == tasks.TOY


@pytest.mark.parametrize(
    ("name", "says"),
    [("moon", "known are car-racing"), ("tests.support.tasks:Moon", "Moon"), ("no.such:Task", "no")],
)
def test_an_unknown_task_is_an_error_that_says_which_there_are(name, says):
    with pytest.raises(UsageError, match=says):
        find_task(name)


def test_a_bundle_of_another_task_is_refused(tmp_path):
    parts = dict.fromkeys(("encoder.onnx", "decoder.onnx", "policy.onnx", "initial_latents.npy"), b"x")
    manifest = Manifest("moon", "moon", "none", (64, 64, 3), latent=4, hidden=4, actions=3)
    with pytest.raises(BundleError, match="of task 'moon'"):
        find_task("car-racing").make_policy(write_bundle(tmp_path / "moon.zip", manifest, parts))


def test_the_judge_is_gymnasiums_own_environment_behind_the_preprocessing():
    judge, plain = find_task("car-racing").make_judge(), gymnasium.make("CarRacing-v3")
    (seen, _), (observed, _) = judge.reset(seed=10_000), plain.reset(seed=10_000)
    action = np.array([0.1, 0.5, 0.0], np.float32)
    for _ in range(3):
        assert (seen == picture(observed)).all()
        (seen, mine, *_), (observed, theirs, *_) = judge.step(action), plain.step(action)
        assert mine == theirs
    judge.close()
    plain.close()


def test_an_episode_begins_from_nothing_whatever_was_driven_before(random_bundle):
    task = find_task("car-racing")
    environment, policy = task.make_environment(), task.make_policy(random_bundle)
    parameters = np.random.default_rng(1).normal(size=random_bundle.controller_shape.size).astype(np.float32)
    scores = [rollout(environment, policy, parameters, Course(seed, 12)) for seed in (1, 2, 1)]
    environment.close()
    assert scores[0] == scores[2] != scores[1]


def test_a_controller_of_another_size_is_refused(random_bundle):
    with pytest.raises(ControllerError, match="15 parameters"):
        find_task("car-racing").make_policy(random_bundle).begin(np.zeros(15, np.float32))
