"""Tests driving.py and world_driving.py."""

import pytest

from dreamfleet.common.artifacts import car_racing_variants
from dreamfleet.common.artifacts.actions import one_hot
from dreamfleet.common.artifacts.car_racing_variants import CAR_RACING, Variant
from dreamfleet.common.artifacts.driving import parse_driving
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
        parse_driving("moon", FACTS, options)
