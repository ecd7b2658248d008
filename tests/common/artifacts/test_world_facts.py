import json

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import Continuous, grouped, one_hot
from dreamfleet.common.artifacts.car_racing_variants import Variant
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


def test_what_is_as_usual_is_not_written():
    written = to_plain(WorldFacts.of(ACTIONS["thirds"], **ABOUT))
    assert sorted(written) == ["frames_per_second", "high", "horizon", "low", "packages", "scale", "shift"]


@pytest.mark.parametrize(
    "change",
    [
        {"low": [0.0]},
        {"low": [2.0, 2.0, 2.0]},
        {"scale": [], "shift": [], "low": [], "high": []},
        {"output_indices": [0, 2, 2]},
        {"output_indices": [-1, 0, 1]},
        {"output_indices": [0, 1, 2**62]},
        {"output_indices": [0, 1]},
        {"choices": [[1.0, 0.0]]},
        {"groups": [[2, 2]]},
        {"groups": [[4, 3]]},
        {"groups": [[3, 3]], "choices": [[1.0, 0.0, 0.0]]},
        {"groups": [[3, 3], [0, 0]]},
        {"groups": [[3]]},
        {"horizon": 0},
        {"end": {"kind": "thresholds", "at": 0.5}},
        {"end": {"kind": "threshold", "at": 1.5}},
        {"end": {"kind": "drawn", "at": 0.5, "odds_weight": 0.0}},
        {"reward": {"source": "score", "gain": 1.0, "cost": 0.0}},
        {"gravity": 9.81},
        {"action_names": ["left", "right"]},
        {"action_names": ["left", "right", "\x1b[2Jstay"]},
        {"score_word": "game\n"},
        {"packages": ["numpy\x07"]},
    ],
    ids=str,
)
def test_facts_that_make_no_world_are_refused(change):
    with pytest.raises(MalformedError):
        from_plain(WorldFacts, {**to_plain(WorldFacts.of(one_hot(3), **ABOUT)), **change})


@pytest.mark.parametrize("text", ["", "drawn ", "half", "-0.1", "1.01", "nan"])
def test_a_rule_that_is_no_share_and_not_drawn_is_refused(text):
    with pytest.raises(UsageError, match="'drawn'"):
        EndRule.parse(text)


@pytest.mark.parametrize("text", ["0.0", "0.25", "0.5", "1.0", "drawn"])
def test_a_rule_is_its_text(text):
    assert EndRule.parse(text).text == text


@pytest.mark.parametrize(("temperature", "share"), [(1.0, 0.2), (2.0, 1 / 3), (0.5, 1 / 17)])
def test_drawn_ends_come_as_often_as_predicted_under_the_temperature(temperature, share):
    bars = EndRule("drawn").bars(np.random.default_rng(7).random(100_000), temperature)
    assert bars.dtype == np.float32
    assert np.mean(np.float32(0.2) > bars) == pytest.approx(share, abs=0.005)


def test_a_drawn_bar_is_where_the_formula_of_the_logits_turns():
    uniform = np.random.default_rng(3).random(1000)
    bars = EndRule("drawn").bars(uniform, 1.15)
    for end in (0.01, 0.3, 0.97):
        squashed = 1 / (1 + np.exp(-np.log(end / (1 - end)) / 1.15))
        assert np.array_equal(end > bars, squashed > uniform)


@pytest.mark.parametrize("weight", [3.0, 10.0])
@pytest.mark.parametrize(("temperature", "share"), [(1.0, 0.2), (2.0, 1 / 3)])
def test_drawn_ends_of_a_model_with_heavier_ends_come_as_often_as_they_really_do(weight, temperature, share):
    predicted = np.float32(weight * 0.2 / (weight * 0.2 + 0.8))  # by a model that was trained with that weight
    bars = EndRule("drawn", odds_weight=weight).bars(np.random.default_rng(7).random(100_000), temperature)
    assert np.mean(predicted > bars) == pytest.approx(share, abs=0.005)


def test_the_weight_of_odds_leaves_thresholds_and_is_written_only_where_it_is_given():
    assert EndRule(odds_weight=3.0).bars(np.array([0.1]), 1.0) == np.float32(0.5)
    for rule, extra in ((EndRule("drawn"), set()), (EndRule("drawn", odds_weight=3.0), {"odds_weight"})):
        assert set(to_plain(rule)) == {"kind", "at", *extra}
        assert from_plain(EndRule, to_plain(rule)) == rule


@pytest.mark.parametrize("weight", [0.0, -1.0, 1e7, float("nan")])
def test_a_weight_that_is_none_is_refused(weight):
    with pytest.raises(UsageError, match="1e-06"):
        EndRule("drawn", odds_weight=weight)


@pytest.mark.parametrize("temperature", [0.01, 1.0, 100.0])
def test_extreme_numbers_give_bars_from_0_to_1(temperature):
    bars = EndRule("drawn").bars(np.array([0.0, 1e-300, np.nextafter(1, 0)]), temperature)
    assert np.all((bars >= 0) & (bars <= 1))
    assert bars[0] == 0
