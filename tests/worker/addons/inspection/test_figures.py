"""`inspect --probe` and `inspect --losses`: what they print, and the allowed drivers.
Tests measure.py, measurements.py and verb.py."""

import json
from dataclasses import replace

import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.worker.addons.inspection.subject import DriverChoice
from tests.support.tables import cells

FOUND = {"z_linear", "z_network", "zh_linear", "zh_network"}


@pytest.mark.slow
def test_a_driver_drives_without_a_controller(call):
    found = json.loads(call("tiny", "--probe", "--driver", "ornstein-uhlenbeck", "--episodes", "8", "--json"))
    assert found["driver"] == "ornstein-uhlenbeck"
    assert found["probe"]["steps"] > 50


@pytest.mark.slow
def test_likeness_prints_how_often_dreams_come_to_what_is_rare(call):
    lines = call("tiny", "--likeness", "--controller", "tiny", "--episodes", "3", "--noise", "0.1").splitlines()
    assert cells(lines[0]) == ["quantity", "rare", "reality", "reality, foreseen", "dream"]
    rows = {cells(line)[0]: cells(line)[2:] for line in lines[1:-1]}
    assert "off_road" not in rows
    assert rows["curvature_20m"][0].startswith("0.1")


@pytest.mark.slow
def test_as_json_both_have_counts_values_and_errors(call):
    found = json.loads(call("--controller", "tiny", "--probe", "--losses", "--episodes", "4", "--json"))
    assert found["bundle"] == find_bundle("tiny").sha256
    assert found["probe"]["drives"] == 4
    for known in found["probe"]["known"]:
        assert set(known["found"]) == FOUND
        assert set(known["found"]["zh_linear"]) == {"value", "error"}
    begun = {each["begun"]: each for each in found["losses"]["begun"]}
    assert {"40 steps before", "20 steps before", "0 steps before"} <= set(begun)
    assert begun["40 steps before"]["count"] == 4
    assert begun["40 steps before"]["figures"]["lost"]["reality"] == {"value": 1.0, "error": 0.0}
    assert found["losses"]["temperature"] == 1.0


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--losses",),
        ("tiny", "--driver", "held"),
        ("tiny", "--probe"),
        ("tiny", "--probe", "--controller", "tiny", "--driver", "held"),
        ("tiny", "--probe", "--driver", "ghost"),
        ("tiny", "--losses", "--driver", "held"),
        ("tiny", "--likeness", "--driver", "held"),
        ("tiny", "--losses", "--controller", "tiny", "--episodes", "3"),
        ("tiny", "--probe", "--controller", "tiny", "--noise", "nan"),
        ("tiny", "--losses", "--controller", "tiny", "--temperature", "0"),
    ],
)
def test_what_cannot_be_measured_is_reported_before_anything_is_driven(call, arguments):
    with pytest.raises(UsageError):
        call(*arguments)


def test_a_controller_of_another_world_model_dreams_nothing(tmp_path):
    bundle, (controller, _) = find_bundle("tiny"), find_controller("tiny", tmp_path)
    other = DriverChoice(replace(controller, bundle="0" * 64), bundle)
    with pytest.raises(UsageError):
        other.dream_controller(bundle)
