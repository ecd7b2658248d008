"""Optimisers as people choose them: frozen with a run, continued, forked from one to another, refused in one line."""

import signal

import numpy as np
import pytest

from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.coordinator.settings.start import latest_mean_and_sigma
from tests.support import tasks
from tests.support.processes import call_here

OWN = "tests.support.optimisers:ParentsAndChildren"


@pytest.fixture
def settings(random_bundle):
    return ("--bundle", random_bundle.path, "--population", 6, "--episodes", 1, "--evaluate-every", 0)


def candidates(processes, name):
    with open_run(processes.runs, name) as run:
        return np.stack([run.candidate(each.number, i) for each in run.history() for i in range(6)])


@pytest.mark.slow
def test_a_run_of_another_optimiser_is_continued_and_forked_to_one_of_ones_own(processes, settings):
    flags = (*settings, "--optimiser", "cmaes-sep", "--generations", 4)
    whole = processes.coordinator(*flags, "--task", tasks.TOY, name="whole")
    processes.worker("--task", tasks.TOY, "--run", "whole")
    assert whole.finish()[0] == 0

    parts = processes.coordinator(*flags, "--task", tasks.SLOW_TOY, name="parts")
    processes.worker("--task", tasks.SLOW_TOY, "--run", "parts")
    parts.wait_for_event("generation", number=1)
    parts.popen.send_signal(signal.SIGTERM)
    assert parts.finish()[0] == 130
    common = ("--runs-dir", processes.runs, "--listen", processes.endpoint, "--beat", "0.2")
    again = processes.start("coordinator", "--resume", "parts", "--generations", 4, *common)
    assert again.finish()[0] == 0
    assert np.array_equal(candidates(processes, "parts"), candidates(processes, "whole"))

    own = ("--optimiser", OWN, "--optimiser-options", "parents=1")
    fork = processes.start("coordinator", "--from", "whole", *own, "--generations", 1, *common)
    processes.worker("--task", tasks.TOY, "--run", "whole-fork")
    assert fork.finish()[0] == 0
    with open_run(processes.runs, "whole") as one, open_run(processes.runs, "whole-fork") as other:
        before, sigma = latest_mean_and_sigma(one)
        assert other.history()[0].sigma == sigma
        assert (other.settings.optimiser, other.settings.optimiser_options) == (OWN, ("parents=1",))
        mean, _ = latest_mean_and_sigma(other)
        assert np.abs(mean - before).max() < 6 * sigma


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--optimiser", "cmea"), "cma, cma-me, cmaes-lra"),
        (("--optimiser", "cmaes-sep", "--preset", "article"), "--covariance diagonal"),
        (("--population", "2"), "3"),
    ],
)
def test_a_search_that_cannot_be_is_refused_before_there_is_a_run(processes, arguments, says):
    code, _, err = call_here("coordinator", "--runs-dir", processes.runs, *arguments)
    assert code == 2
    assert says in err.strip().splitlines()[-1]
    assert "Traceback" not in err
    assert not processes.runs.exists() or not any(processes.runs.iterdir())
