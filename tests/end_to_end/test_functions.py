"""A Python function on a fleet: who called it, and who died meanwhile, changes no bit; NaN is no end of a run."""

import pytest

from dreamfleet.common.runs.run_folder import open_run

GENERATIONS, POPULATION = 4, 8
TASK = "function:tests.support.objectives:pausing"
SETTINGS = (
    "--bundle", "none", "--population", POPULATION, "--episodes", 3, "--generations", GENERATIONS, "--seed", 5,
    "--evaluate-every", 0,
)  # fmt: skip


def coordinator(processes, name, task=TASK, *more):
    options = ("--environment", "x0=[1,2,3]", "minimise=true")
    return processes.coordinator(*SETTINGS, "--task", task, *options, *more, name=name)


@pytest.mark.slow
def test_a_worker_that_did_not_announce_the_function_is_refused_and_nan_ranks_last(processes):
    task = "function:tests.support.objectives:holed"
    run = coordinator(processes, "holed", task, "--failure-limit", 1, "--sigma0", "0.5")
    other = processes.worker("--run", "holed", "--task", TASK, "--name", "other")
    other.wait_for(f"{task}`")  # the command that mends it, with all tasks that the worker has
    processes.worker("--run", "holed", "--task", task, "--name", "own")
    assert run.finish()[0] == 0
    with open_run(processes.runs, "holed") as stored:
        assert len(stored.history()) == GENERATIONS
        assert sum(each.failed for each in stored.history()) > 0
        assert {each.cause for each in stored.failures()} == {"ObjectiveError"}
    assert processes.call("runs", "show", "holed", "--runs-dir", processes.runs)[1].count("reported x") == 1
