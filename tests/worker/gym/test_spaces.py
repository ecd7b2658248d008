"""Observations and actions of any space as vectors."""

import numpy as np
import pytest
from gymnasium import spaces

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import describe_task
from dreamfleet.worker.gym.spaces import make_converter, vector_actions
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task
from tests.support.strict_environments import ACTIONS, STRICT


def test_a_space_has_as_many_choices_as_elements():
    for space in (
        spaces.MultiDiscrete([2, 3], start=[5, 0]),
        spaces.Dict({"b": spaces.Discrete(3, start=2), "a": spaces.Tuple((spaces.MultiBinary(2), spaces.Discrete(2)))}),
    ):
        actions = vector_actions(space, "it")
        convert = make_converter(space, actions)
        elements = [convert(np.float32(choice)) for choice in actions.choices]
        assert all(each in space for each in elements)
        flat = [tuple(spaces.flatten(space, each)) for each in elements]
        assert flat == list(actions.choices)
        assert len(set(flat)) == len(flat) == actions.outputs


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
    ("space", "says"),
    [
        (spaces.MultiDiscrete([9, 9]), "takes 81 different actions: wrap it so that they are 64 at most"),
        (spaces.Tuple((spaces.Discrete(2), spaces.Box(0, 1, (1,)))), "flat Box of floats, or Discrete"),
        (ACTIONS["endless"], "without bounds"),
        (spaces.Box(-np.inf, 1, (1,)), "without bounds"),
        (spaces.Text(3), "flat Box of floats, or Discrete"),
        (spaces.Dict({}), "flat Box of floats, or Discrete"),
    ],
)
def test_other_actions_are_refused_with_what_to_write(space, says):
    with pytest.raises(UsageError, match=says):
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
