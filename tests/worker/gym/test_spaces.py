"""Observations and actions of any space as vectors."""

import numpy as np
import pytest
from gymnasium import spaces

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.gym.spaces import make_converter, vector_actions


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
        (spaces.Box(0, 3, (1,), np.int64), "takes whole numbers"),
        (spaces.Box(-np.inf, 1, (1,)), "without bounds"),
        (spaces.Text(3), "flat Box of floats, or Discrete"),
        (spaces.Dict({}), "flat Box of floats, or Discrete"),
    ],
)
def test_other_actions_are_refused_with_what_to_write(space, says):
    with pytest.raises(UsageError, match=says):
        vector_actions(space, "it")
