"""Tests driving.py and world_driving.py too: the options of any world."""

import json
import re

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE, one_hot
from dreamfleet.common.artifacts.car_racing_variants import CAR_RACING, FACTS, Variant
from dreamfleet.common.artifacts.driving import parse_driving
from dreamfleet.common.artifacts.world_facts import WorldFacts
from dreamfleet.common.errors import UsageError

OPTIONS = (
    '{"pedals": "one"}', '{"pedals": "half"}', '{"actions": "discrete"}', '{"actions": "linear"}',
    '{"pedal_shift": 0.25, "pedals": "one"}', '{"decide_every": 4}', '{"feedback": "last"}', '{"time_cost": 0.5}',
    '{"offroad_cost": 2.0}', '{"actions": "discrete", "decide_every": 4}',
    '{"decide_every": 2, "feedback": "last", "pedals": "one", "time_cost": 1.0}',
)  # fmt: skip


@pytest.mark.parametrize("options", OPTIONS)
def test_options_round_trip(options):
    variant = Variant.from_json(options)
    assert variant.options == options
    assert (variant.is_default, variant.version) == (False, 3 if variant.without_costs.is_default else 2)


def test_the_default_variant_has_empty_options():
    plain = Variant()
    for options in ("", '{"pedals": "two", "decide_every": 1, "time_cost": 0}'):
        assert Variant.from_json(options) == plain
    assert (plain.options, plain.is_default, plain.version, plain.extra_features) == ("", True, 1, 0)
    assert (plain.controls, plain.option_texts) == (STEERING_GAS_BRAKE, ())
    assert Variant.from_json('{"time_cost": 2}').options == '{"time_cost": 2.0}', "equal numbers, equal options"


def test_half_pedals_press_gas_and_brake_halfway_at_zero_and_linear_outputs_are_the_action():
    outputs = np.array([[0, 0, 0], [9, 9, 9], [-9, -9, -9]], np.float32)
    pressed = Variant(pedals="half").controls.to_action(outputs)
    assert pressed.round(4).tolist() == [[0, 0.5, 0.5], [1, 1, 1], [-1, 0, 0]]
    outputs = np.array([[0, 0.5, -2], [3, 1, 0.25]], np.float32)
    assert np.array_equal(Variant(actions="linear").controls.to_action(outputs), outputs)
    assert Variant(actions="linear").controls.low == (-1, 0, 0)
    with pytest.raises(UsageError, match="`squashed`"):
        WorldFacts.of(Variant(actions="linear").controls, packages=(), horizon=10, frames_per_second=30)


def test_costs_and_feedback_are_options_and_do_not_change_the_controls():
    both = Variant(pedals="one", decide_every=4, time_cost=0.25, offroad_cost=2.0)
    assert both.option_texts == ("pedals=one", "decide_every=4", "time_cost=0.25", "offroad_cost=2.0")
    assert both.without_costs == Variant(pedals="one", decide_every=4)
    for options, features in (({}, 6), ({"pedals": "one"}, 4), ({"actions": "discrete"}, 10)):
        assert Variant(feedback="last", **options).extra_features == features, "two an output"


def test_the_error_for_an_unknown_option_lists_the_known_ones():
    with pytest.raises(UsageError, match=r"car-racing.* gears, pedal.* actions, pedals, pedal_shift, ") as raised:
        Variant.from_json('{"pedal": "one", "gears": 5}')
    assert all(name in str(raised.value) for name in Variant.HELP)
    assert "\n" not in str(raised.value)
    for options in ("{", "[1]", "7", '"one"'):
        with pytest.raises(UsageError, match=re.escape(options)):
            Variant.from_json(options)


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


def test_a_pedal_shift_is_bounded():
    assert Variant(pedals="one", pedal_shift=-1).controls.shift == (0, -1, 1)
    for pedals in ("one", "half"):
        with pytest.raises(UsageError, match=r"actions .*'discrete'"):
            Variant(actions="discrete", pedals=pedals)
    for pedals, shift in (("half", 0.5), ("one", 1.5)):
        with pytest.raises(UsageError, match=f"pedal_shift .*{shift}"):
            Variant(pedals=pedals, pedal_shift=shift)


MOON = WorldFacts.of(one_hot(3), packages=("numpy",), horizon=525, frames_per_second=9, version=4)


def test_the_options_of_car_racing_are_a_variant_whatever_its_facts():
    for facts in (FACTS, MOON):
        assert parse_driving(CAR_RACING, facts, '{"pedals": "one"}') == Variant(pedals="one")
    with pytest.raises(UsageError):
        parse_driving("moon", FACTS, '{"pedals": "one"}')


@pytest.mark.parametrize("options", ["", '{"decide_every": 4}', '{"feedback": "last"}'])
def test_the_options_of_another_world_are_what_they_were_parsed_from(options):
    driving = parse_driving("moon", MOON, options)
    assert driving.options == options
    assert driving.is_default == (not options)
    assert driving.controls == one_hot(3)
    assert driving.version == 4
    assert driving.without_costs == driving


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ('{"pedals": "one", "time_cost": 1}', "moon .*pedals, time_cost.* decide_every"),
        ('{"decide_every": 0}', "decide_every .*0"),
        ('{"feedback": "first"}', "feedback .*'first'"),
        ("[]", "moon"),
    ],
)
def test_other_options_are_refused(options, named):
    with pytest.raises(UsageError, match=named):
        parse_driving("moon", MOON, options)
