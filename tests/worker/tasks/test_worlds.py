"""Worlds that are recorded under options, and bundles that describe them.
Tests recordable.py, world.py and worker/worlds/car_racing/task.py."""

import json
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import Assignment, Continuous, Discrete, Mirror, Task, World, one_hot
from dreamfleet.worker.tasks.recordable import Preprocessing, RecordableTask, TaskWithBeginnings, TaskWithOptions
from dreamfleet.worker.tasks.registry import find_scored_task, find_task, find_world, preprocessing_for, task_of
from dreamfleet.worker.worldmodel.policy import ModelPolicy
from tests.support.bundles import write_world_bundle

FLASH = f"{__name__}:Flash"


class Flashes(gymnasium.Env):
    """Grey pictures; a point for action 1, times `gain`."""

    observation_space, action_space = spaces.Box(0, 255, (64, 64, 3), np.uint8), spaces.Box(0, 1, (3,), np.float32)

    def __init__(self, gain):
        self.gain = gain

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._picture(), {}

    def step(self, action):
        return self._picture(), float(self.gain * action[1]), False, False, {}

    def _picture(self):
        return np.full((64, 64, 3), self.np_random.integers(256), np.uint8)


class DrawnActions:
    """A random driver."""

    def __init__(self, random):
        self.random = random

    def act(self):
        return np.eye(3, dtype=np.float32)[self.random.integers(3)]


class Flash(Task):
    """A task that is recordable only under options."""

    name = FLASH
    world = World(one_hot(3), ("numpy", "onnxruntime"), horizon=50, score_word="game", marks=(10,))

    def parse_options(self, arguments):
        return json.dumps({"gain": int(arguments["gain"])}) if arguments else ""

    def with_options(self, options):
        return RecordedFlash(**json.loads(options or "{}"))

    def make_environment(self, assignment):
        return Flashes(1)

    def make_policy(self, assignment):
        return ModelPolicy(assignment.world_model)


class RecordedFlash(Flash):
    """The task under options."""

    preprocessings: ClassVar = {"box-64": Preprocessing("box-64", 64, lambda picture: picture)}
    drivers: ClassVar = {"uniform": DrawnActions}

    def __init__(self, gain=1):
        self.gain = gain

    def make_environment(self, assignment):
        return self.make_recorded(preprocessing_for(assignment.world_model, self).name)

    def make_recorded(self, preprocessing):
        return Flashes(self.gain)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    facts = Flash.world.facts(RewardFacts("survival"), EndRule("drawn"), '{"gain": 3}')
    return write_world_bundle(tmp_path_factory.mktemp("flash") / "flash.zip", facts, FLASH)


def test_a_world_with_options_is_found_under_them():
    assert not isinstance(find_task(FLASH), RecordableTask)
    assert isinstance(find_task(FLASH), TaskWithOptions)
    assert find_world(FLASH).gain == 1
    assert find_world(FLASH, find_task(FLASH).parse_options({"gain": "4"})).gain == 4


def test_a_world_without_options_takes_none():
    assert not isinstance(find_task("car-racing"), TaskWithOptions)
    assert isinstance(find_world("car-racing"), TaskWithBeginnings)
    assert not isinstance(find_world(FLASH), TaskWithBeginnings)
    with pytest.raises(UsageError, match=r"'car-racing'"):
        find_world("car-racing", '{"gain": 4}')
    with pytest.raises(UsageError):
        find_world("dream")


def test_a_bundles_task_has_the_options_that_it_was_recorded_under(bundle, random_bundle):
    assert task_of(bundle).gain == 3
    assert find_scored_task(FLASH, bundle).gain == 3
    assert find_scored_task("dream", bundle).name == "dream"
    assert find_scored_task("gym:CartPole-v1", None).name == "gym:CartPole-v1"
    assert task_of(random_bundle).name == "car-racing"


def test_a_bundle_of_other_pictures_is_refused(bundle, random_bundle):
    assert preprocessing_for(bundle, task_of(bundle)).size == 64
    with pytest.raises(BundleError, match=r"'car-racing'.*'box-64'"):
        preprocessing_for(random_bundle, find_world(FLASH))


@pytest.mark.parametrize("options", ["", '{"decide_every": 3}', '{"feedback": "last"}'])
def test_a_world_is_scored_by_its_world_model_under_its_options(bundle, options):
    driving = bundle.with_options(None, options)
    spec = TaskSpec(FLASH, bundle.sha256, 30, 0, driving.controller_shape, options=options)
    parameters = np.random.default_rng(2).normal(0, 1, driving.controller_shape.size).astype(np.float32)
    scores = []
    for _ in range(2):
        scorer = Scorer(spec, bundle)
        scores.append(scorer.score("score", parameters, seed=5))
        scorer.close()
    assert scores[0] == scores[1]
    assert scores[0].steps == 30
    assert scores[0].fitness % 3 == 0


def test_a_policy_of_any_world_gives_its_actions(bundle):
    policy = find_scored_task(FLASH, bundle).make_policy(Assignment.of(FLASH, bundle))
    policy.begin(np.zeros(bundle.controller_shape.size, np.float32))
    action = policy.act(np.zeros((64, 64, 3), np.uint8))
    policy.reward(1.0)
    assert action.tolist() == [1, 0, 0]
    assert action.dtype == np.float32


def test_a_worlds_facts_are_what_the_coordinator_needs(bundle):
    facts = bundle.manifest.world
    assert facts.actions == one_hot(3)
    assert (facts.horizon, facts.frames_per_second, facts.packages) == (50, 30, ("numpy", "onnxruntime"))
    assert (facts.score_word, facts.marks, facts.options) == ("game", (10.0,), '{"gain": 3}')
    with pytest.raises(UsageError, match="one_hot"):
        World(Discrete(3)).facts(RewardFacts(), EndRule())


@pytest.mark.parametrize("actions", [one_hot(2), Discrete(3), Continuous.between([-1], [1])])
def test_a_mirror_of_another_number_of_actions_makes_no_world(actions):
    with pytest.raises(UsageError):
        World(actions, mirror=Mirror((0, 2, 1), (1, 1, 1)))
