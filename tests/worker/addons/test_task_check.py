"""What a dry run finds in environments, each with one fault; without the processes around it."""

import numpy as np
import pytest

from dreamfleet.worker.addons.task_check import FaultError, dry_run
from dreamfleet.worker.tasks import closing
from tests.support.environments import ACTIONS, STRICT
from tests.support.stuck_environments import MODULE


def try_out(name, announce=lambda _step: None, **arguments):
    *_, found = dry_run(f"gym:{name}", {"environment": arguments}, announce, thorough=True)
    return found


@pytest.mark.parametrize("actions", sorted({*ACTIONS} - {"endless"}))
def test_both_ends_of_the_actions_are_tried(actions):
    assert try_out(STRICT, actions=actions).warnings == ()


@pytest.mark.parametrize(
    ("actions", "breaks"),
    [("float64", -0.1), ("float64", 0.1), ("float64", [0.1, -0.1]), ("bytes", 255), ("start", -7)],
)
def test_an_action_that_the_environment_cannot_take_is_named(actions, breaks):
    announced = []
    with pytest.raises(RuntimeError):
        try_out(STRICT, announced.append, actions=actions, breaks=breaks)
    assert all(str(number) in announced[-1] for number in np.atleast_1d(breaks))


def test_observations_beyond_single_precision_are_warned_of():
    with np.errstate(all="ignore"):
        found = try_out(STRICT, huge=True)
    assert len([each for each in found.warnings if not each.startswith("gymnasium's checker")]) == 1


def test_a_close_that_hangs_is_called_so(monkeypatch):
    monkeypatch.setattr(closing, "CLOSE_LIMIT", 0.2)
    monkeypatch.setattr(closing, "_hung", {})
    announced = []
    found = try_out(f"{MODULE}:StuckClose-v0", announced.append)
    assert announced[-1] == "close()"
    assert found.warnings == tuple(closing._hung.values()) != ()


def test_a_reward_that_is_no_number_is_a_fault():
    with pytest.raises(FaultError):
        try_out("tests.support.environments:Odd-v0", fault="infinite")
