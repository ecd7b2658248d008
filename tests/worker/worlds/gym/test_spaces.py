"""Observations and actions of any space as vectors."""

from itertools import product
from math import prod

import numpy as np
import pytest
from gymnasium import spaces

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import describe_task
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worlds.gym.spaces import make_converter, vector_actions
from tests.support.strict_environments import ACTIONS, STRICT


def test_a_space_has_a_group_of_outputs_for_each_number():
    for space in (
        spaces.MultiDiscrete([2, 3], start=[5, 0]),
        spaces.Dict({"b": spaces.Discrete(3, start=2), "a": spaces.Tuple((spaces.MultiBinary(2), spaces.Discrete(2)))}),
    ):
        actions = vector_actions(space, "it")
        convert = make_converter(space, actions)
        rows = actions.from_numbers(list(product(*map(range, actions.sizes))))
        elements = [convert(row) for row in rows]
        assert all(each in space for each in elements)
        flat = [tuple(spaces.flatten(space, each)) for each in elements]
        assert flat == [tuple(row) for row in rows]
        assert len(set(flat)) == len(flat) == prod(actions.sizes)
        assert actions.outputs == sum(actions.sizes)


def test_an_action_near_a_choice_is_that_choice():
    space = spaces.MultiDiscrete([2, 3])
    convert = make_converter(space, vector_actions(space, "it"))
    assert convert(np.float32([0.2, 0.7, 0.1, 0.1, 0.3])).tolist() == [1, 2]


def test_bounded_numbers_anywhere_are_one_vector():
    space = spaces.Dict({"turn": spaces.Box(-1, 1, (2, 2), np.float32), "gas": spaces.Box(0, 3, (1,), np.float64)})
    actions = vector_actions(space, "it")
    assert actions == Continuous.between([0, -1, -1, -1, -1], [3, 1, 1, 1, 1])
    taken = make_converter(space, actions)(np.float32([2, 0.1, 0.2, 0.3, 0.4]))
    assert taken in space
    assert taken["turn"].tolist() == np.float32([[0.1, 0.2], [0.3, 0.4]]).tolist()


@pytest.mark.parametrize(
    "space",
    [
        spaces.MultiDiscrete([4096, 1]),
        spaces.Discrete(4097),
        spaces.MultiBinary(2049),
        spaces.Box(0, 1, (4097,)),
        spaces.Tuple((spaces.Discrete(2), spaces.Box(0, 1, (1,)))),
        ACTIONS["endless"],
        spaces.Box(-np.inf, 1, (1,)),
        spaces.Text(3),
        spaces.Dict({}),
    ],
)
def test_other_actions_are_refused(space):
    with pytest.raises(UsageError):
        vector_actions(space, "it")


def spec(kind):
    about = describe_task(f"gym:{STRICT}", {"environment": {"actions": kind}})
    return TaskSpec(
        f"gym:{STRICT}", "", 1000, 0, ControllerShape(about.observations, about.outputs), options=about.options
    )


TAKEN = [each for each in ACTIONS if each != "endless"]


@pytest.mark.parametrize("kind", TAKEN)
def test_a_saturated_controller_stays_within_the_space(kind):
    scorer = Scorer(spec(kind))
    for value in (-1e6, 0, 1e6):
        parameters = np.full(scorer.spec.controller.size, value, np.float32)
        assert scorer.score("score", parameters, 1).fitness == 20
    scorer.close()


@pytest.mark.parametrize("kind", TAKEN)
def test_a_world_models_actions_stay_within_the_space(kind):
    space = ACTIONS[kind]
    actions = vector_actions(space, "it")
    convert = make_converter(space, actions)
    for value in (-1e6, 0, 1e6):
        assert convert(actions.to_action(np.full(actions.outputs, value, np.float32))) in space


def test_an_environment_of_single_precision_gets_the_vector_as_it_is():
    assignment = Assignment(spec("float32"))
    task = find_task(assignment.spec.task)
    action = np.float32([0.05, -0.1])
    with task.make_environment(assignment) as environment:
        environment.reset(seed=1)
        assert environment.step(action)[4]["taken"] is action


def test_whole_numbers_are_the_nearest():
    convert = make_converter(ACTIONS["mixed"], vector_actions(ACTIONS["mixed"], "it"))
    taken = convert(np.float32([2.6, 0.1]))
    assert (taken["gear"].tolist(), taken["gear"].dtype, taken["turn"].dtype) == ([3], np.int8, np.float64)


@pytest.mark.parametrize(
    ("space", "outputs"),
    [
        (spaces.MultiDiscrete([11, 11, 11]), 33),
        (spaces.MultiDiscrete([[3, 2], [4, 5]], start=[[1, 0], [0, 9]]), 14),
        (spaces.MultiBinary(12), 24),
        (spaces.MultiBinary((2, 3)), 12),
        (spaces.Discrete(4096, start=3), 4096),
        (spaces.MultiDiscrete([4095, 1]), 4096),
        (spaces.Tuple((spaces.Discrete(100), spaces.MultiBinary(2))), 104),
    ],
)
def test_each_number_is_chosen_by_its_own_outputs(space, outputs):
    actions = vector_actions(space, "it")
    convert = make_converter(space, actions)
    assert actions.outputs == outputs
    logits = np.random.default_rng(1).normal(size=(5, outputs)).astype(np.float32)
    together = actions.to_action(logits)
    for row, action in zip(logits, together, strict=True):
        assert np.array_equal(actions.to_action(row), action)
        element = convert(action)
        assert element in space
        assert np.array_equal(spaces.flatten(space, element), action)
        parts = np.split(row, np.cumsum(actions.sizes)[:-1])
        assert actions.to_numbers(action).tolist() == [int(part.argmax()) for part in parts]
        chosen = np.concatenate([np.arange(len(part)) == part.argmax() for part in parts])
        assert np.array_equal(actions.to_outputs(action), chosen)
