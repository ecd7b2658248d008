"""The facts of a world, its actions, and its options. Tests actions.py, car_racing_variants.py, driving.py and
world_driving.py."""

import json
import re

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE, Continuous, Mirror, grouped, one_hot
from dreamfleet.common.artifacts.car_racing_variants import CAR_RACING, FACTS, Variant
from dreamfleet.common.artifacts.driving import parse_driving
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts, WorldFacts
from dreamfleet.common.errors import UsageError
from dreamfleet.common.schema.validation import MalformedError, from_plain, to_plain

ABOUT = {"packages": ("numpy", "vizdoom"), "horizon": 525, "frames_per_second": 9}
ACTIONS = {
    "one-hot": one_hot(3),
    "thirds": Continuous.between([-1], [1]),
    "shared outputs": Variant(pedals="one", pedal_shift=0.25).controls,
    "groups": grouped([3, 2, 1], bits=[1]),
    "choices": Variant(actions="discrete").controls,
}


@pytest.mark.parametrize("actions", ACTIONS.values(), ids=ACTIONS)
def test_facts_are_the_same_after_json(actions):
    facts = WorldFacts.of(
        actions, **ABOUT, reward=RewardFacts("survival", gain=4.0), end=EndRule("drawn"), options='{"skip": 4}',
        version=2, score_word="game", marks=(750.0,),
        action_names=tuple(f"move {number}" for number in range(actions.actions)),
    )  # fmt: skip
    found = from_plain(WorldFacts, json.loads(json.dumps(to_plain(facts))))
    assert found == facts
    assert found.actions == actions
    logits = np.random.default_rng(1).normal(size=(9, actions.outputs)).astype(np.float32)
    assert np.array_equal(found.actions.to_action(logits), actions.to_action(logits))
    usual = to_plain(WorldFacts.of(ACTIONS["thirds"], **ABOUT))
    assert sorted(usual) == ["frames_per_second", "high", "horizon", "low", "packages", "scale", "shift"]


@pytest.mark.parametrize(
    "change",
    [
        {"low": [0.0]},
        {"low": [2.0, 2.0, 2.0]},
        {"scale": [], "shift": [], "low": [], "high": []},
        *({"output_indices": wrong} for wrong in ([0, 2, 2], [-1, 0, 1], [0, 1, 2**62], [0, 1])),
        {"choices": [[1.0, 0.0]]},
        *({"groups": wrong} for wrong in ([[2, 2]], [[4, 3]], [[3, 3], [0, 0]], [[3]])),
        {"groups": [[3, 3]], "choices": [[1.0, 0.0, 0.0]]},
        {"horizon": 0},
        *({"end": {"kind": kind, "at": at}} for kind, at in (("thresholds", 0.5), ("threshold", 1.5))),
        {"end": {"kind": "drawn", "at": 0.5, "odds_weight": 0.0}},
        {"reward": {"source": "score", "gain": 1.0, "cost": 0.0}},
        {"gravity": 9.81},
        *({"action_names": ["left", "right", *names]} for names in ([], ["\x1b[2Jstay"])),
        {"score_word": "game\n"},
        {"packages": ["numpy\x07"]},
    ],
    ids=str,
)
def test_facts_that_make_no_world_are_refused(change):
    with pytest.raises(MalformedError):
        from_plain(WorldFacts, {**to_plain(WorldFacts.of(one_hot(3), **ABOUT)), **change})


def test_a_rule_is_its_text_a_share_or_drawn():
    for text in ("0.0", "0.25", "0.5", "1.0", "drawn"):
        assert EndRule.parse(text).text == text
    for text in ("", "drawn ", "half", "-0.1", "1.01", "nan"):
        with pytest.raises(UsageError, match="'drawn'"):
            EndRule.parse(text)


def test_a_drawn_bar_is_where_the_formula_of_the_logits_turns():
    uniform = np.random.default_rng(3).random(1000)
    bars = EndRule("drawn").bars(uniform, 1.15)
    for end in (0.01, 0.3, 0.97):
        squashed = 1 / (1 + np.exp(-np.log(end / (1 - end)) / 1.15))
        assert np.array_equal(end > bars, squashed > uniform)
    for temperature in (0.01, 1.0, 100.0):
        bars = EndRule("drawn").bars(np.array([0.0, 1e-300, np.nextafter(1, 0)]), temperature)
        assert np.all((bars >= 0) & (bars <= 1))
        assert bars[0] == 0


@pytest.mark.parametrize("weight", [1.0, 3.0, 10.0])
@pytest.mark.parametrize(("temperature", "share"), [(1.0, 0.2), (2.0, 1 / 3), (0.5, 1 / 17)])
def test_drawn_ends_come_as_often_as_in_reality_under_the_temperature(weight, temperature, share):
    predicted = np.float32(weight * 0.2 / (weight * 0.2 + 0.8))  # by a model whose ends weigh so much in training
    bars = EndRule("drawn", odds_weight=weight).bars(np.random.default_rng(7).random(100_000), temperature)
    assert bars.dtype == np.float32
    assert np.mean(predicted > bars) == pytest.approx(share, abs=0.005)


def test_the_weight_of_odds_leaves_thresholds_and_is_written_only_where_it_is_given():
    assert EndRule(odds_weight=3.0).bars(np.array([0.1]), 1.0) == np.float32(0.5)
    for rule, extra in ((EndRule("drawn"), set()), (EndRule("drawn", odds_weight=3.0), {"odds_weight"})):
        assert set(to_plain(rule)) == {"kind", "at", *extra}
        assert from_plain(EndRule, to_plain(rule)) == rule
    for weight in (0.0, -1.0, 1e7, float("nan")):
        with pytest.raises(UsageError, match="1e-06"):
            EndRule("drawn", odds_weight=weight)


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
