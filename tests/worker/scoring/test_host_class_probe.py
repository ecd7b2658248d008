"""The class of a host depends only on the bits that it computes on fixed inputs. Tests common/host/fingerprint.py."""

import numpy as np
import pytest

from dreamfleet import ControllerShape, Scorer, TaskSpec
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC, class_from_fingerprint
from dreamfleet.worker.scoring.host_class_probe import HostClassProbe, fixed_parameters
from dreamfleet.worker.tasks.model_free_policies import FlatPolicy
from dreamfleet.worker.worlds.car_racing import environment
from tests.support import tasks
from tests.support.environments import ODD

CART_POLE = TaskSpec("gym:CartPole-v1", "", 500, 0, ControllerShape(4, 2))


def scorer_of(task, bundle):
    return Scorer(TaskSpec(task, bundle.sha256, 100, 0), bundle)


@pytest.mark.parametrize("task", ["car-racing", "dream"])
def test_the_host_class_does_not_depend_on_what_ran_before(random_bundle, task):
    job = "score", fixed_parameters(random_bundle.controller_shape.size), 7
    scorer, again = scorer_of(task, random_bundle), scorer_of(task, random_bundle)
    found, score = scorer.host_class, again.score(*job)
    assert len(found) == 16
    assert again.host_class == found
    assert scorer.score(*job) == again.score(*job) == score


@pytest.mark.parametrize("task", [tasks.ROUNDED, "car-racing"])
def test_another_bit_of_the_world_and_a_simulator_that_fuses_products_are_another_class(
    random_bundle, monkeypatch, task
):
    here = scorer_of(task, random_bundle).host_class
    monkeypatch.setenv(tasks.ROUNDING, "1")
    monkeypatch.setattr(environment, "box2d_fuses_products", lambda: True)
    assert scorer_of(task, random_bundle).host_class != here


def test_another_bit_of_a_policys_outputs_is_another_class_and_another_package_version_is_not(monkeypatch):
    here = Scorer(CART_POLE).host_class
    monkeypatch.setattr("dreamfleet.worker.scoring.scorer.fingerprint", lambda _: "riscv64 other")
    assert Scorer(CART_POLE).host_class == here
    outputs = FlatPolicy.outputs
    monkeypatch.setattr(FlatPolicy, "outputs", lambda self, seen: np.nextafter(outputs(self, seen), np.float32(9)))
    assert Scorer(CART_POLE).host_class != here


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
    assert fixed_parameters(3).tobytes() == fixed_parameters(867)[:3].tobytes()
    assert fixed_parameters(3).tobytes().hex() == "cebb713d192207beda4c353e"


@pytest.mark.parametrize("fault", ["noise", "random", "carry"])
def test_an_environment_that_is_not_deterministic_has_a_class_of_its_own(fault):
    options = f'{{"environment": {{"fault": "{fault}"}}}}'
    assert Scorer(TaskSpec(ODD, "", 20, 0, ControllerShape(2, 2), options=options)).host_class == NON_DETERMINISTIC
