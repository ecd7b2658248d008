import json
import re

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import STEERING_AND_HALVES, STEERING_GAS_BRAKE
from dreamfleet.common.artifacts.car_racing_variants import DEFAULT_VARIANT, Variant
from dreamfleet.common.artifacts.world_facts import WorldFacts
from dreamfleet.common.errors import UsageError


@pytest.mark.parametrize(
    "options",
    [
        '{"pedals": "one"}',
        '{"pedals": "half"}',
        '{"actions": "discrete"}',
        '{"actions": "linear"}',
        '{"actions": "discrete", "decide_every": 4}',
        '{"pedal_shift": 0.25, "pedals": "one"}',
        '{"decide_every": 4}',
        '{"feedback": "last"}',
        '{"time_cost": 0.5}',
        '{"offroad_cost": 2.0}',
        '{"decide_every": 2, "feedback": "last", "pedals": "one", "time_cost": 1.0}',
    ],
)
def test_options_round_trip(options):
    variant = Variant.from_json(options)
    assert variant.options == options
    assert Variant.from_json(variant.options) == variant
    assert (variant.is_default, variant.version) == (False, 3 if variant.without_costs.is_default else 2)


def test_the_default_variant_has_empty_options():
    assert (
        Variant.from_json("")
        == Variant.from_json('{"pedals": "two", "decide_every": 1, "time_cost": 0}')
        == DEFAULT_VARIANT
    )
    plain = DEFAULT_VARIANT
    assert (plain.options, plain.is_default, plain.version, plain.extra_features) == ("", True, 1, 0)
    assert plain.controls == STEERING_GAS_BRAKE
    assert Variant.from_json('{"time_cost": 2}').options == '{"time_cost": 2.0}', "equal numbers, equal options"


def test_half_pedals_press_gas_and_brake_halfway_at_zero():
    assert Variant(pedals="half").controls == STEERING_AND_HALVES
    outputs = np.array([[0, 0, 0], [9, 9, 9], [-9, -9, -9]], np.float32)
    pressed = Variant(pedals="half").controls.to_action(outputs)
    assert pressed.round(4).tolist() == [[0, 0.5, 0.5], [1, 1, 1], [-1, 0, 0]]


def test_linear_outputs_are_the_action():
    outputs = np.array([[0, 0.5, -2], [3, 1, 0.25]], np.float32)
    assert np.array_equal(Variant(actions="linear").controls.to_action(outputs), outputs)
    assert Variant(actions="linear").controls.low == (-1, 0, 0)
    with pytest.raises(UsageError, match="`squashed`"):
        WorldFacts.of(Variant(actions="linear").controls, packages=(), horizon=10, frames_per_second=30)


def test_option_texts_are_name_value_pairs():
    assert Variant(pedals="one", decide_every=4, time_cost=0.25).option_texts == (
        "pedals=one", "decide_every=4", "time_cost=0.25",
    )  # fmt: skip
    assert DEFAULT_VARIANT.option_texts == ()


def test_penalties_do_not_change_the_controls():
    assert Variant(time_cost=0.5, offroad_cost=2.0).without_costs == DEFAULT_VARIANT
    assert Variant(pedals="one", time_cost=0.5).without_costs == Variant(pedals="one")


def test_feedback_adds_two_features_an_output():
    assert Variant(feedback="last").extra_features == 6
    assert Variant(feedback="last", pedals="one").extra_features == 4
    assert Variant(feedback="last", actions="discrete").extra_features == 10


def test_the_error_for_an_unknown_option_lists_the_known_ones():
    with pytest.raises(UsageError, match=r"car-racing.* gears, pedal.* actions, pedals, pedal_shift, ") as raised:
        Variant.from_json('{"pedal": "one", "gears": 5}')
    assert all(name in str(raised.value) for name in Variant.HELP)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("actions", ["five", 1, None]),
        ("pedals", ["three", 1, ["one"], None]),
        ("pedal_shift", [0.5, "0", True]),  # of two pedals
        ("decide_every", [0, 51, 2.0, True, "4"]),
        ("feedback", ["first", False]),
        ("time_cost", [-0.1, 101, float("nan"), "1", True]),
        ("offroad_cost", [-0.1, 101, float("inf"), "1", False]),
    ],
)
def test_the_error_for_a_value_out_of_range_describes_the_range(name, values):
    for value in values:
        with pytest.raises(UsageError) as raised:
            Variant.from_json(json.dumps({name: value}))
        assert all(each in str(raised.value) for each in (name, Variant.HELP[name], repr(value)))


@pytest.mark.parametrize("options", ["{", "[1]", "7", '"one"'])
def test_options_must_be_a_json_object(options):
    with pytest.raises(UsageError, match=re.escape(options)):
        Variant.from_json(options)


def test_a_pedal_shift_is_bounded():
    assert Variant(pedals="one", pedal_shift=-1).controls.shift == (0, -1, 1)
    for pedals in ("one", "half"):
        with pytest.raises(UsageError, match=r"actions .*'discrete'"):
            Variant(actions="discrete", pedals=pedals)
    for pedals, shift in (("half", 0.5), ("one", 1.5)):
        with pytest.raises(UsageError, match=f"pedal_shift .*{shift}"):
            Variant(pedals=pedals, pedal_shift=shift)
