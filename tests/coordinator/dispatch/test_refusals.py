from dataclasses import replace

import pytest

from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.protocol.host_classes import class_from_fingerprint
from dreamfleet.common.protocol.keys import PROTOCOL_VERSION
from dreamfleet.coordinator.dispatch.refusals import MAX_REFUSED, RefusedWorkers, find_refusal
from tests.support.samples import JSON

HELLO = next(each for each in JSON.values() if type(each).__name__ == "HelloRequest")
LANDER, PACKAGES = "gym:LunarLander-v3", ("numpy", "gymnasium", "box2d", "box2d-py")


def hello(**changes):
    spoken = {"protocol_min": PROTOCOL_VERSION, "protocol_max": PROTOCOL_VERSION}
    return replace(HELLO, **spoken, **{"tasks": ("car-racing", "gym"), "fingerprint": "here", **changes})


@pytest.mark.parametrize("tasks", [("gym",), (LANDER,), ("dream", "gym")])
def test_a_familys_name_stands_for_all_its_members(tasks):
    assert find_refusal(hello(tasks=tasks, packages=PACKAGES), LANDER, None, PACKAGES) is None


def test_a_refusal_for_an_unknown_task_says_what_to_install():
    why, remedy, task = find_refusal(hello(tasks=("dream",)), LANDER, None)
    assert LANDER in why
    assert "dream" in why
    assert remedy
    assert task == ""
    assert find_refusal(hello(), "field:FieldTask", None).task == "field:FieldTask"


def test_a_fingerprint_of_other_packages_is_asked_for_again_before_it_is_judged():
    why, remedy, _ = find_refusal(hello(), LANDER, None, PACKAGES)
    assert "numpy, gymnasium, box2d" in why
    assert remedy
    about = hello(packages=PACKAGES, fingerprint=fingerprint(PACKAGES))
    assert find_refusal(about, LANDER, class_from_fingerprint(fingerprint(PACKAGES)), PACKAGES) is None
    assert find_refusal(about, LANDER, class_from_fingerprint("elsewhere"), PACKAGES)


@pytest.mark.parametrize(
    ("host_class", "admitted", "may_join"),
    [
        ("a" * 16, None, True),
        ("a" * 16, "a" * 16, True),
        ("a" * 16, "b" * 16, False),
        ("", "b" * 16, True),  # it does not know yet
        ("a" * 16, class_from_fingerprint("here"), True),  # the run goes by fingerprints
        ("", class_from_fingerprint("elsewhere"), False),
    ],
)
def test_a_strict_run_admits_its_own_class_and_workers_of_an_unknown_class(host_class, admitted, may_join):
    found = find_refusal(hello(packages=PACKAGES, host_class=host_class), LANDER, admitted, PACKAGES)
    assert (found is None) == may_join


def test_another_worlds_package_does_not_change_a_fingerprint():
    assert fingerprint(("numpy",)) == fingerprint(("numpy", "no-such-package"))
    assert fingerprint(("numpy",)) != fingerprint(("numpy", "gymnasium"))


def test_refusals_are_logged_once_are_bounded_and_end_with_admission():
    refused_workers = RefusedWorkers()
    assert refused_workers.add("a/1", "no task")
    assert not refused_workers.add("a/2", "no task")
    assert refused_workers.add("a/3", "another fingerprint")
    for number in range(MAX_REFUSED):
        refused_workers.add(f"w{number}/1", "no task")
    assert len(refused_workers.latest) == MAX_REFUSED
    assert "a" not in refused_workers.latest
    refused_workers.remove("w3/9")
    assert "w3" not in refused_workers.latest


def test_a_family_does_not_stand_for_a_member_that_names_a_module():
    task = "gym:some_module:World-v0"
    assert find_refusal(hello(tasks=("gym",)), task, None).task == task
    assert find_refusal(hello(tasks=("gym", task), packages=PACKAGES), task, None, PACKAGES) is None
