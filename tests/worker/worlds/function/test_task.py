"""The task of a Python function: one call is an episode of one step."""

import re

import numpy as np
import pytest

from dreamfleet import ControllerShape, Scorer, TaskSpec
from dreamfleet.common.addons.task_check.task_check import try_task
from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.errors import RefusedError, UsageError
from dreamfleet.common.protocol.tasks import family_of, module_of
from dreamfleet.worker.tasks.registry import check_task_allowed, find_task
from dreamfleet.worker.worlds.function.task import ObjectiveError

MODULE = "tests.support.objectives"
TWO = {"x0": [0.0, 3.0], "minimise": True}


def name(function):
    return f"function:{MODULE}:{function}"


def scorer(function, **arguments):
    options = Objective.of({**TWO, **arguments}).options
    return Scorer(TaskSpec(name(function), "", 1, 0, ControllerShape(0, 2), options=options))


def score(function, seed=1, coordinates=(0.5, -1.0), kind="score", **arguments):
    return scorer(function, **arguments).score(kind, np.array(coordinates, np.float32), seed)


@pytest.mark.parametrize("kind", ["score", "evaluate"])
def test_a_call_is_an_episode_of_one_step_whose_fitness_is_the_negative_value(kind):
    found = score("sphere", kind=kind)
    assert (found.fitness, found.steps) == (-1.25, 1)
    assert score("sphere", minimise=False).fitness == 1.25
    assert score("Shifted.value").fitness == -1.25
    assert score("weighted").fitness == -3.75
    assert score("steady", 7) == score("steady", 8), "its seed is bound"
    assert score("weighted.noisy", 7) != score("weighted.noisy", 8)


def test_the_seed_alone_makes_the_noise():
    one, same, other = score("noisy", 7), score("noisy", 7), score("noisy", 8)
    assert one == same != other
    assert score("noisy", 2**53 - 1) == score("noisy", 2**53 - 1)  # folded to what NumPy takes


def test_a_function_that_writes_into_its_argument_changes_nothing_else():
    one, parameters = scorer("changing"), np.array([0.5, -1.0], np.float32)
    assert [one.score("score", parameters, 1).fitness for _ in range(3)] == [-4.5] * 3


@pytest.mark.parametrize(
    ("function", "named"),
    [
        ("raising", r"ZeroDivisionError: .*\(objectives\.py:\d+\)"),
        ("exiting", "SystemExit: 3"),
        ("wrong", r"AssertionError: objectives\.py:\d+"),
        ("nothing", "NoneType None"),
        ("vector", r"\(2,\)"),
        ("text", "str '12'"),
        ("infinite", "inf"),
    ],
)
def test_what_is_no_number_fails_the_candidate_and_refuses_the_run_before_it_begins(function, named):
    with pytest.raises(ObjectiveError, match=named):
        score(function)
    assert re.search(named, try_task(name(function), {"environment": TWO}).fault)


def test_a_penalty_stands_for_nan_and_infinity():
    assert score("infinite", penalty=1e6).fitness == -1e6
    assert score("holed", coordinates=(2, 0), penalty=50).fitness == -50


@pytest.mark.parametrize(("function", "named"), [("sphere", ""), ("noisy", ""), ("varying", "`seed`")])
def test_the_dry_run_calls_it_twice_and_compares(function, named):
    varies = try_task(name(function), {"environment": TWO}).varies
    assert (bool(varies), named in varies) == (bool(named), True)


@pytest.mark.parametrize(
    ("task", "named"),
    [
        ("function", "function"),
        ("function:tests.support.objectives", "function"),
        (f"function:{MODULE}:nowhere", "nowhere"),
        (f"function:{MODULE}:NUMBER", "int"),
        ("function:nowhere_at_all:cost", "--trust nowhere_at_all"),
    ],
)
def test_what_names_no_function_is_refused_in_one_line(task, named):
    with pytest.raises(UsageError, match=named) as raised:
        find_task(task)
    assert "\n" not in str(raised.value)


def test_a_worker_scores_it_only_if_that_very_function_is_announced():
    task = name("sphere")
    assert module_of(task) == MODULE
    assert family_of(task) == task
    check_task_allowed(task, ("function", task))
    with pytest.raises(RefusedError, match=f"--task {task}"):
        check_task_allowed(task, ("function", name("noisy")))
