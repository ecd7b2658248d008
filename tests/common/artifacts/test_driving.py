import json

import pytest

from dreamfleet.common.artifacts import car_racing_variants
from dreamfleet.common.artifacts.actions import Continuous, one_hot
from dreamfleet.common.artifacts.car_racing_variants import CAR_RACING, Variant
from dreamfleet.common.artifacts.driving import WorldDriving, parse_driving
from dreamfleet.common.artifacts.world_facts import WorldFacts
from dreamfleet.common.errors import UsageError

FACTS = WorldFacts.of(one_hot(3), packages=("numpy",), horizon=525, frames_per_second=9, version=4)


def test_the_options_of_car_racing_are_a_variant_whatever_its_facts():
    for facts in (car_racing_variants.FACTS, FACTS):
        assert parse_driving(CAR_RACING, facts, '{"pedals": "one"}') == Variant(pedals="one")
    with pytest.raises(UsageError):
        parse_driving("moon", car_racing_variants.FACTS, '{"pedals": "one"}')


@pytest.mark.parametrize("options", ["", '{"decide_every": 4}', '{"feedback": "last"}'])
def test_the_options_of_another_world_are_what_they_were_parsed_from(options):
    driving = parse_driving("moon", FACTS, options)
    assert driving.options == options
    assert driving.is_default == (not options)
    assert driving.controls == one_hot(3)
    assert driving.version == 4
    assert driving.without_costs == driving


def test_feedback_is_two_features_for_each_output():
    last = '{"feedback": "last"}'
    thirds = WorldFacts.of(Continuous.between([-1], [1]), packages=(), horizon=5, frames_per_second=9)
    assert parse_driving("moon", FACTS, last).extra_features == 6
    assert parse_driving("moon", thirds, last).extra_features == 2
    assert parse_driving("moon", FACTS, "").extra_features == 0


def test_options_are_also_texts():
    assert WorldDriving(FACTS, 4, "last").option_texts == ("decide_every=4", "feedback=last")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            '{"pedals": "one", "time_cost": 1}',
            "moon knows no option pedals, time_cost: known are decide_every",
        ),
        ('{"decide_every": 0}', "decide_every must be a whole number from 1 to 50, not 0"),
        ('{"decide_every": true}', "decide_every must be a whole number"),
        ('{"feedback": "first"}', "feedback must be none or last, not 'first'"),
        ("[]", "moon's options must be a JSON object"),
        ("{", "moon's options must be a JSON object"),
        (json.dumps("x"), "moon's options must be a JSON object"),
    ],
)
def test_other_options_are_refused(options, said):
    with pytest.raises(UsageError, match=said):
        parse_driving("moon", FACTS, options)
