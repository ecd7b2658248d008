"""Search coordinates and the arguments of a function that they stand for."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamfleet.common.artifacts.objective import Objective, takes_seed
from dreamfleet.common.errors import UsageError
from tests.support import objectives

MIXED = {
    "x0": [0.5, 3, 10, -2, 4], "scale": [0.1, 1, 1, 2, 1], "lower": [0, 1, 1, None, None],
    "upper": [1, 5, 1000, 0, None], "integer": [1], "log": [2],
}  # fmt: skip


def test_zero_is_x0_and_a_step_is_the_scale():
    objective = Objective.of(MIXED)
    assert objective.decode(np.zeros(5)).tolist() == pytest.approx([0.5, 3, 10, -2, 4])
    assert objective.decode([1, 1, 1, -1, 1]).tolist() == pytest.approx([0.6, 4, 10 * np.e, -4, 5])
    assert objective.decode([0, 0.4, 0, 0, 0])[1] == 3


@given(st.floats(-50, 50), st.floats(0, 1e-3))
def test_reflection_makes_no_jump(place, step):
    box = Objective.of({"x0": [0.5], "lower": 0, "upper": 1})
    assert abs(box.decode([place + step])[0] - box.decode([place])[0]) <= step + 1e-12


@given(st.lists(st.floats(-(2.0**100), 2.0**100, width=32), min_size=5, max_size=5))
def test_arguments_lie_within_bounds_wherever_the_search_goes(coordinates):
    x = Objective.of(MIXED).decode(np.array(coordinates, np.float32))
    assert np.isfinite(x).all()
    assert 0 <= x[0] <= 1
    assert x[1] in (1, 2, 3, 4, 5)
    assert 1 <= x[2] <= 1000
    assert x[3] <= 0


def test_every_whole_number_is_as_probable_as_another():
    box = Objective.of({"x0": [2], "lower": 1, "upper": 4, "integer": True})
    drawn = [float(box.decode([u])[0]) for u in np.linspace(-40, 40, 8001)]
    counts = np.unique(drawn, return_counts=True)
    assert counts[0].tolist() == [1, 2, 3, 4]
    assert np.ptp(counts[1]) < 0.05 * 8001 / 4


@given(st.floats(-(2.0**40), 2.0**40, width=32))
def test_a_rounded_parameter_is_a_whole_number_within_its_bounds(coordinate):
    for more in ({}, {"lower": -2.5, "upper": 7.5}, {"x0": [3], "lower": 1, "upper": 9, "log": True}):
        found = Objective.of({"x0": [0], "integer": True, **more}).decode([coordinate])
        assert found.dtype == np.float64
        assert found[0] == int(found[0])
        assert more.get("lower", -np.inf) <= found[0] <= more.get("upper", np.inf)


def test_options_come_back_and_equal_numbers_are_one():
    for given_ in (MIXED, {"x0": 0, "dimension": 300, "minimise": True, "penalty": 1e6}, {"x0": "1, 2"}):
        objective = Objective.of(given_)
        assert Objective.parse(objective.options) == objective
    assert json.loads(Objective.of({"x0": [0, 0, 0]}).options) == {"environment": {"dimension": 3, "x0": 0.0}}
    assert len(Objective.of({"x0": 0, "dimension": 10**4}).options) < 100
    assert [Objective.of({"x0": [0], "minimise": sign}).value(3.0) for sign in (True, False)] == [-3.0, 3.0]


def test_equal_bounds_fix_a_parameter():
    bounds = {"lower": [1, 0, 2, 5], "upper": [1, 9, 2, 5]}
    objective = Objective.of({"x0": [1, 2, 2, 5], **bounds, "integer": [2], "log": [3]})
    for coordinates in ([0, 0, 0, 0], [1e-9, 1, -1, 0.1], [-1e9, -1e9, 1e9, 700]):
        x = objective.decode(coordinates)
        assert x[[0, 2, 3]].tolist() == [1, 2, 5]
        assert 0 <= x[1] <= 9


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        *({"x0": odd} for odd in ([], ["a"], [float("nan")], [True])),
        *({"x0": [0], **odd} for odd in ({"lower": 1}, {"scale": 0}, {"log": [0]})),
        *({"x0": [0, 0], **odd} for odd in ({"dimension": 3}, {"lower": [1]})),
        {"x0": [1, 2], "lower": [1, 2], "upper": [1, 2]},
        {"x0": [1], "log": True, "lower": 0},
        *({"x0": [1], **odd} for odd in ({"integer": [1]}, {"minimise": "yes"}, {"penalty": [1, 2]}, {"step": 3})),
        {"x0": [1, 0.5], "lower": [0, 0.2], "upper": [9, 0.9], "integer": [1]},
        {"x0": 1, "dimension": 0},
        5,
        [],
        ["x0"],
        None,
    ],
)
def test_what_describes_no_function_is_refused(arguments):
    with pytest.raises(UsageError):
        Objective.of(arguments)
    for text in ("", "3", "[]", "{}", '{"environment": 3}', '{"environment": []}'):
        with pytest.raises(UsageError):
            Objective.parse(text)


def test_a_second_parameter_named_seed_makes_a_function_noisy():
    assert takes_seed(objectives.noisy)
    assert not takes_seed(objectives.sphere)
    assert not takes_seed(lambda seed: seed)
    assert not takes_seed(max)
