"""A run that is continued: from its start, with what it had, by the words that it left, and on another host.

Tests coordinator/settings/start.py, common/runs/run_paths.py and coordinator/settings/resume_settings.py.
"""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks
from tests.support.processes import DEADLINE, call_here, environment, free_port, printed


def stopped(processes, *flags):
    """A run that was stopped in its third generation: its worker, and what it said last."""
    coordinator = processes.coordinator(*flags)
    worker = processes.worker("--task", tasks.SLOW_TOY)
    coordinator.wait_for_event("generation", number=1)
    assert coordinator.stop()[0] == 130
    return worker, coordinator.lines[-1]


@pytest.mark.slow
def test_the_hint_of_a_run_that_was_left_is_a_whole_command_with_its_limits_and_its_network(processes, small):
    processes.runs = processes.folder / "all my runs"
    worker, said = stopped(processes, *small, "--generations", 4, "--strict")
    command, env = said[said.index(sys.executable) :], environment(processes.cache)
    done = subprocess.run(command, shell=True, env=env, capture_output=True, check=False, timeout=DEADLINE)
    assert done.returncode == 0, done.stderr
    assert worker.popen.poll() is None
    with open_run(processes.runs, "test") as run:
        assert json.loads(run.fact("limits")) == {"generations": 4}
        assert json.loads(run.fact("network")) == {"listen": [processes.endpoint], "beat": 0.2, "strict": True}


@pytest.mark.slow
def test_what_is_given_as_a_run_goes_on_is_stronger_and_is_kept_but_for_what_is_frozen(processes, small):
    stopped(processes, *small, "--generations", 60, "--minutes", 30)
    file = processes.folder / "fleet.toml"
    file.write_text("[run]\npopulation = 64\nepisodes = 1\n")  # of another run
    elsewhere = f"tcp/127.0.0.1:{free_port()}"
    again = processes.resume("test", "--listen", elsewhere, "--generations", 3, "--config", file)
    processes.worker("--task", tasks.SLOW_TOY, endpoint=elsewhere)
    again.wait_for_event("kept", setting="population")
    assert again.finish()[0] == 0
    assert not again.events("kept", setting="episodes")
    with open_run(processes.runs, "test") as run:
        assert json.loads(run.fact("limits")) == {"generations": 3, "minutes": 30}
        assert json.loads(run.fact("network")) == {"listen": [elsewhere], "beat": 0.2}
    out = printed("coordinator", "--resume", "test", "--runs-dir", processes.runs, "--json")
    assert json.loads(out)["ended"] == "3 generations"


@pytest.mark.slow
def test_a_run_moves_to_another_place_and_its_worker_follows(processes, small):
    """The worker is given both addresses; the folder is all that moves."""
    first, second = processes.endpoint, f"tcp/127.0.0.1:{free_port()}"
    parts = processes.coordinator(*small, "--generations", 4, name="parts")
    worker = processes.start("worker", "--connect", first, second, "--slots", 1, "--task", tasks.SLOW_TOY)
    parts.wait_for_event("generation", number=1)
    assert parts.stop()[0] == 130
    elsewhere = processes.folder / "elsewhere"
    shutil.copytree(processes.runs / "parts", elsewhere / "parts")
    again = processes.start("coordinator", "--resume", "parts", "--runs-dir", elsewhere, "--listen", second)
    worker.wait_for_event("rejoined")
    assert again.finish()[0] == 0
    with open_run(elsewhere, "parts") as run:
        assert len(run.history()) == 4


@pytest.mark.slow
def test_one_file_serves_coordinator_worker_and_status(processes, random_bundle):
    path = processes.folder / "fleet.toml"
    path.write_text(
        f'connect = ["{processes.endpoint}"]\nlisten = ["{processes.endpoint}"]\nruns_dir = "{processes.runs}"\n'
        f'[run]\npreset = "frugal"\nbundle = "{random_bundle.path}"\ntask = "{tasks.TOY}"\npopulation = 4\n'
        "evaluate_every = 0\n[limits]\ngenerations = 2\n[worker]\nslots = 1\nexit_when_done = true\n"
    )
    coordinator = processes.start("coordinator", "--run", "filed", "--config", path)
    coordinator.wait_for_event("begin")
    out = printed("status", "--config", path, "--json")
    status = json.loads(out)
    assert (status["run"], status["settings"]["population"], status["settings"]["episodes"]) == ("filed", 4, 2)
    worker = processes.start("worker", "--config", path, "--task", tasks.TOY)
    assert coordinator.finish()[0] == 0
    assert worker.finish()[0] == 0
    assert "\nfiled " in call_here("runs", "list", "--config", path)[1]


SIGMA = 0.01


def test_a_start_outlives_a_coordinator_that_was_killed_at_once_and_its_own_file(processes, small, random_bundle):
    shape, start = random_bundle.default_shape, processes.folder / "start.npz"
    mean = np.linspace(1, 2, shape.size, dtype=np.float32)
    Controller(shape, mean, tasks.TOY, random_bundle.sha256).save(start)
    flags = ("--init", start, "--sigma0", SIGMA, "--task", tasks.TOY, "--generations", 1, "--strict")
    began = processes.coordinator(*small, *flags, name="night")
    began.popen.kill()  # before anything is scored
    began.finish()
    start.unlink()
    again = processes.resume("night")
    again.wait_for_event("begin")
    assert again.stop()[0] == 130
    with open_run(processes.runs, "night") as run:
        population = np.stack([run.candidate(0, number) for number in range(4)])
        assert np.abs(population - mean).max() < 10 * SIGMA
        assert "start.npz" in run.fact("start")
        assert run.fact("limits") == '{"generations": 1}'
        assert '"strict": true' in run.fact("network")
