"""Observations and actions of any space as vectors."""

from itertools import product
from math import prod

import numpy as np
import pytest
from gymnasium import spaces

from dreamfleet import Continuous, Scorer, UsageError
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worlds.gym.spaces import make_converter, vector_actions
from tests.support.environments import ACTIONS, STRICT
from tests.support.specs import described_spec


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


def scorer(kind):
    return Scorer(described_spec(f"gym:{STRICT}", environment={"actions": kind}))


@pytest.mark.parametrize("kind", sorted({*ACTIONS} - {"endless"}))
def test_saturated_controllers_and_world_models_stay_within_the_space(kind):
    actions, made = vector_actions(ACTIONS[kind], "it"), scorer(kind)
    convert = make_converter(ACTIONS[kind], actions)
    for value in (-1e6, 0, 1e6):
        assert convert(actions.to_action(np.full(actions.outputs, value, np.float32))) in ACTIONS[kind]
        assert made.score("score", np.full(made.spec.controller.size, value, np.float32), 1).fitness == 20


def test_an_environment_of_single_precision_gets_the_vector_as_it_is():
    action = np.float32([0.05, -0.1])
    with find_task(f"gym:{STRICT}").make_environment(Assignment(scorer("float32").spec)) as environment:
        environment.reset(seed=1)
        assert environment.step(action)[4]["taken"] is action


def test_whole_numbers_are_the_nearest():
    convert = make_converter(ACTIONS["mixed"], vector_actions(ACTIONS["mixed"], "it"))
    taken = convert(np.float32([2.6, 0.1]))
    assert (taken["gear"].tolist(), taken["gear"].dtype, taken["turn"].dtype) == ([3], np.int8, np.float64)


@pytest.mark.parametrize(
    "space",
    [
        spaces.MultiDiscrete([2, 3], start=[5, 0]),
        spaces.Dict({"b": spaces.Discrete(3, start=2), "a": spaces.Tuple((spaces.MultiBinary(2), spaces.Discrete(2)))}),
    ],
)
def test_each_row_of_choices_is_another_element_of_the_space_and_a_row_near_it_is_the_same(space):
    actions = vector_actions(space, "it")
    convert = make_converter(space, actions)
    rows = actions.from_numbers(list(product(*map(range, actions.sizes))))
    flat = [tuple(spaces.flatten(space, convert(row))) for row in rows]
    assert all(convert(row) in space for row in rows)
    assert flat == [tuple(row) for row in rows]
    assert flat == [tuple(spaces.flatten(space, convert(0.6 * row + 0.2))) for row in rows]
    assert len(set(flat)) == len(flat) == prod(actions.sizes)


@pytest.mark.parametrize(
    ("space", "outputs"),
    [
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
