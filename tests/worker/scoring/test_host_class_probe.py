"""The class of a host depends only on the bits that it computes on fixed inputs. Tests common/host/fingerprint.py."""

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC, HostClasses, class_from_fingerprint
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.scoring.host_class_probe import HostClassProbe, fixed_parameters
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.policy import FlatPolicy
from dreamfleet.worker.worlds.car_racing import environment
from tests.support import tasks
from tests.support.environments import ODD

CART_POLE = TaskSpec("gym:CartPole-v1", "", 500, 0, ControllerShape(4, 2))


def scorer_of(task, bundle):
    return Scorer(TaskSpec(task, bundle.sha256, 100, 0), bundle)


@pytest.mark.parametrize("task", ["car-racing", "dream"])
def test_the_host_class_does_not_depend_on_what_ran_before(random_bundle, task):
    scorer = scorer_of(task, random_bundle)
    found = scorer.host_class
    assert len(found) == 16
    again = scorer_of(task, random_bundle)
    again.score("score", fixed_parameters(random_bundle.controller_shape.size), seed=7)
    assert again.host_class == found
    before = scorer.score("score", fixed_parameters(random_bundle.controller_shape.size), seed=7)
    assert before == again.score("score", fixed_parameters(random_bundle.controller_shape.size), seed=7)


def test_another_bit_of_the_world_is_another_class(random_bundle, monkeypatch):
    here = scorer_of(tasks.ROUNDED, random_bundle).host_class
    monkeypatch.setenv(tasks.ROUNDING, "1")
    assert scorer_of(tasks.ROUNDED, random_bundle).host_class != here


def test_a_simulator_that_fuses_products_is_another_class(random_bundle, monkeypatch):
    here = scorer_of("car-racing", random_bundle).host_class
    monkeypatch.setattr(environment, "box2d_fuses_products", lambda: True)
    assert scorer_of("car-racing", random_bundle).host_class != here


def test_another_bit_of_a_policys_outputs_is_another_class(monkeypatch):
    here = Scorer(CART_POLE).host_class
    outputs = FlatPolicy.outputs
    monkeypatch.setattr(FlatPolicy, "outputs", lambda self, seen: np.nextafter(outputs(self, seen), np.float32(9)))
    assert Scorer(CART_POLE).host_class != here


def test_another_package_version_is_the_same_class(monkeypatch):
    here = Scorer(CART_POLE).host_class
    monkeypatch.setattr("dreamfleet.worker.scoring.scorer.fingerprint", lambda _: "riscv64 other")
    assert Scorer(CART_POLE).host_class == here


@pytest.mark.parametrize("task", [tasks.RAISING, tasks.CRASHING])
def test_without_a_probe_episode_the_fingerprint_gives_the_class(random_bundle, task):
    scorer = scorer_of(task, random_bundle)
    assert scorer.host_class == class_from_fingerprint(fingerprint(scorer.world.packages))


def test_all_observed_values_count_and_memory_addresses_do_not():
    def host_class(value):
        found = HostClassProbe()
        found.add_value(value)
        return found.host_class

    assert host_class({"a": 1, "b": (1.5, None)}) == host_class({"b": (1.5, None), "a": 1})
    assert host_class(np.float32(0.0)) != host_class(np.float32(-0.0))
    assert host_class(0.1 + 0.2) != host_class(0.3)
    assert host_class(np.zeros(2)) != host_class(np.zeros((2, 1)))
    assert host_class([object()]) == host_class([object()])


def test_the_parameters_are_the_same_bits_everywhere():
    assert (
        fixed_parameters(3).tobytes().hex() == fixed_parameters(867)[:3].tobytes().hex() == "cebb713d192207beda4c353e"
    )


@pytest.mark.parametrize("fault", ["noise", "random", "carry"])
def test_an_environment_that_is_not_deterministic_has_a_class_of_its_own(fault):
    options = f'{{"environment": {{"fault": "{fault}"}}}}'
    found = Scorer(TaskSpec(ODD, "", 20, 0, ControllerShape(2, 2), options=options)).host_class
    assert found == NON_DETERMINISTIC
    assert HostClasses.of({(found, "x"): 3}).description.startswith("not deterministic: 100.0% of the results")
