import re

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE, Mirror, grouped, one_hot
from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.errors import UsageError

ONE_PEDAL, FIVE = Variant(pedals="one").controls, Variant(actions="discrete").controls


def logits(*outputs):
    return np.arctanh(np.array(outputs, np.float32))


@pytest.mark.parametrize(
    ("shift", "pressed"),
    [
        (0.0, [(0.75, 0.75, 0), (-0.5, 0, 0.5), (0.0, 0, 0)]),
        (0.25, [(0.9, 1, 0), (0.0, 0.25, 0), (-0.25, 0, 0), (-0.5, 0, 0.25)]),
    ],
)
def test_one_pedal_is_gas_above_its_shift_and_brake_below(shift, pressed):
    controls = Variant(pedals="one", pedal_shift=shift).controls
    assert (controls.outputs, controls.actions) == (2, 3)
    for pedal, gas, brake in pressed:
        np.testing.assert_allclose(controls.to_action(logits(0.25, pedal)), [0.25, gas, brake], atol=1e-6)


def test_the_choice_of_the_largest_output_wins_and_the_first_of_equal_ones():
    assert (FIVE.outputs, FIVE.actions) == (5, 3)
    assert FIVE.to_action(np.array([9, -1, 0, 9, 3], np.float32)).tolist() == [0, 0, 0]
    many = np.random.default_rng(0).normal(size=(64, 5)).astype(np.float32) * 9
    assert np.array_equal(FIVE.to_outputs(FIVE.to_action(many)), np.eye(5)[many.argmax(axis=1)])
    assert not FIVE.to_outputs(np.array([[0.5, 0, 0]], np.float32)).any(), "what is no choice was none"
    assert one_hot(3).to_action(np.array([[2, 1, 0], [0, 0, 0], [-3, -2, -1]])).argmax(axis=1).tolist() == [0, 0, 2]
    with pytest.raises(UsageError):
        one_hot(0)


@pytest.mark.parametrize("controls", [ONE_PEDAL, STEERING_GAS_BRAKE, FIVE, one_hot(3), grouped([3, 2, 1], bits=[1])])
def test_a_batch_of_actions_equals_single_actions(controls):
    many = np.random.default_rng(0).normal(size=(64, controls.outputs)).astype(np.float32) * 9
    together = controls.to_action(many)
    assert (together.shape, together.dtype) == ((64, controls.actions), np.float32)
    assert all(np.array_equal(controls.to_action(row), action) for row, action in zip(many, together, strict=True))


def test_actions_convert_back_to_outputs():
    given = np.array([[0.25, -0.5], [-1.0, 0.75], [0.0, 0.0]], np.float32)
    np.testing.assert_allclose(
        ONE_PEDAL.to_outputs(ONE_PEDAL.to_action(np.arctanh(given * 0.9))), given * 0.9, atol=1e-6
    )
    action = np.array([[0.1, 0.2, 0.3]], np.float32)
    assert STEERING_GAS_BRAKE.to_outputs(action) is action


def test_a_mirror_is_exact_and_twice_nothing():
    steering = Mirror((0, 1, 2), (-1, 1, 1))
    action = np.random.default_rng(2).normal(size=(50, 3)).astype(np.float32)
    assert np.array_equal(steering.apply(action), action * np.array([-1, 1, 1], np.float32))
    assert np.array_equal(steering.apply(steering.apply(action)), action)
    moves = Mirror((0, 2, 1), (1, 1, 1))
    assert moves.apply(np.eye(3, dtype=np.float32)).tolist() == [[1, 0, 0], [0, 0, 1], [0, 1, 0]]


@pytest.mark.parametrize("shape", [(5, 1), (5, 2), (1,), (), (5, 4)])
def test_a_mirror_widens_no_action(shape):
    with pytest.raises(UsageError, match=re.escape(str(shape))):
        Mirror((0, 1, 2), (-1, 1, 1)).apply(np.zeros(shape, np.float32))


@pytest.mark.parametrize(("order", "signs"), [((0, 1), (1, 1, 1)), ((0, 0), (1, 1)), ((1, 2), (1, 1)), ((0,), ())])
def test_a_mirror_orders_each_column_once(order, signs):
    with pytest.raises(UsageError):
        Mirror(order, signs)
