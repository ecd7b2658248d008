"""A run's start is in its journal before anything is scored: a coordinator that is continued begins there.
Tests coordinator/settings/start.py."""

import signal

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks

SIGMA = 0.01


@pytest.fixture
def settings(small):
    return (*small, "--sigma0", SIGMA, "--task", tasks.TOY, "--generations", 1)


@pytest.fixture
def controller(random_bundle, tmp_path):
    """Parameters far away from zero."""
    shape = random_bundle.default_shape
    controller = Controller(shape, np.linspace(1, 2, shape.size, dtype=np.float32), tasks.TOY, random_bundle.sha256)
    controller.save(tmp_path / "start.npz")
    return tmp_path / "start.npz"


def killed(processes, *words):
    """Started, and killed before anything is scored."""
    began = processes.start(*words, "--runs-dir", processes.runs, "--listen", processes.endpoint)
    began.wait_for_event("begin")
    began.popen.kill()
    began.finish()


def continued(processes, name):
    """What it asks for first when it is continued; it has left, so that this is on disk."""
    again = processes.resume(name)
    again.wait_for_event("begin")
    again.popen.send_signal(signal.SIGTERM)
    assert again.finish()[0] == 130
    with open_run(processes.runs, name) as run:
        return np.stack([run.candidate(0, number) for number in range(4)])


def test_a_start_outlives_a_coordinator_that_was_killed_at_once_and_its_own_file(processes, settings, controller):
    mean = Controller.load(controller).parameters
    killed(processes, "coordinator", "--run", "night", "--init", controller, *settings, "--strict")
    controller.unlink()
    population = continued(processes, "night")
    assert np.abs(population - mean).max() < 10 * SIGMA
    with open_run(processes.runs, "night") as run:
        assert "start.npz" in run.fact("start")
        assert run.fact("limits") == '{"generations": 1}'
        assert '"strict": true' in run.fact("network")


@pytest.mark.slow
def test_a_fork_that_was_killed_at_once_goes_on_from_its_source_though_that_is_gone(processes, settings, controller):
    mean = Controller.load(controller).parameters
    first = processes.coordinator(*settings, "--init", controller, name="first")
    processes.worker("--task", tasks.TOY, "--run", "first", "--exit-when-done")
    assert first.finish()[0] == 0
    killed(processes, "coordinator", "--from", "first")
    processes.call("runs", "delete", "first", "--yes", "--runs-dir", processes.runs)
    assert np.abs(continued(processes, "first-fork") - mean).max() < 10 * SIGMA
