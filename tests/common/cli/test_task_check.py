"""Trials of real environments, each with one fault, in real child processes."""

import re

import pytest

from dreamfleet.common.cli.task_check import try_task
from tests.support.environments import ODD


def trial(fault, name=ODD, **options):
    limit = options.pop("limit", 300)
    return try_task(name, {"environment": {"fault": fault}, **options}, limit)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("old step", r"its step returns 4 values, not five values .*: that is the API from before gymnasium 0\.26"),
        ("old reset", "its reset returns an array of shape .*, not an observation and a dictionary"),
        ("array", r"its reward is an array of shape \(2,\), not one number"),
        ("infinite", "its reward is inf, not a finite number"),
        ("none", "its reward is a value of type NoneType"),
        ("nan", "its first observation holds NaN or infinity"),
        ("raise", "its first steps raised RuntimeError: the engine stalled"),
        ("exit", r"reset\(seed=0\) raised SystemExit: 3"),
        ("exit at once", r"reset\(seed=0\) ended the process \(exit code 3\)"),
        ("crash", r"reset\(seed=0\) crashed \(SIGSEGV\)"),
    ],
)
def test_a_fault_is_one_line_that_says_what_the_environment_did(fault, says):
    found = trial(fault)
    assert found.description is None
    assert found.fault.startswith(f"{ODD} cannot be scored: ")
    assert "\n" not in found.fault
    assert re.search(says, found.fault), found.fault


def test_the_old_api_is_found_without_gymnasiums_wrappers_too():
    assert "its step returns 4 values" in trial("old step", ODD.replace("Odd-", "OddEndless-")).fault


def test_a_hang_ends_at_the_limit():
    assert trial("hang", limit=20).fault.endswith("cannot be scored: reset(seed=0) took longer than 20 s")


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("random", "two resets with one seed give different first observations"),
        ("noise", "equal actions after two resets with one seed"),
        ("carry", "equal actions after two resets with one seed"),
        ("hash", "in two processes"),
    ],
)
def test_what_differs_between_equal_episodes_is_named_with_the_remedy(fault, says):
    found = trial(fault)
    assert (found.fault, found.compared) == ("", True)
    assert says in found.varies
    assert "self.np_random" in found.varies


def test_a_sound_environment_is_described_without_a_word():
    found = trial("noisy", normalise=True, seed=2**40)
    assert (found.fault, found.warnings, found.compared, found.varies) == ("", (), True, "")
    assert (found.description.observations, found.description.outputs) == (2, 2)
    assert '"normal"' in found.description.options


def test_gymnasiums_checker_only_warns():
    assert any("not within the observation space" in text for text in trial("outside").warnings)
    found = trial("checker")  # the process is gone, and what was found before counts
    assert (found.fault, found.varies) == ("", "")
    assert found.warnings == ("gymnasium's checker ended the process (exit code 4)",)


def test_pictures_are_hinted_at():
    found = try_task("gym:CarRacing-v3", {})
    assert found.fault == ""
    assert "task car-racing drives this track on a world model" in found.warnings[0]
