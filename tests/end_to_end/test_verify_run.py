"""A run is repeated from its controller's provenance alone, with real processes, to the bit.
Tests dreamfleet/experiments/verbs/verify_run.py."""

import json
import os
import shlex
import signal
import subprocess
import sys

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.common.runs.run_provenance import read_run_provenance
from tests.support import tasks
from tests.support.processes import DEADLINE, ROOT
from tests.support.same_bits import evolve

STAGES = """
[[stage]]
generations = 2
horizon = 4

[[stage]]
horizon = 10
population = 7
sigma0 = 0.3
"""


@pytest.mark.slow
def test_a_run_of_two_stages_from_a_controller_is_repeated_through_a_kill_and_a_script_says_if_it_is_not_the_same(
    processes, small, random_bundle, tmp_path
):
    (tmp_path / "stages.toml").write_text(STAGES)
    shape = random_bundle.controller_shape
    start = np.linspace(-1, 1, shape.size, dtype=np.float32)
    Controller(shape, start, tasks.TOY, random_bundle.sha256).save(tmp_path / "start.npz")
    evolve(
        processes, "first", 1, *small, "--task", tasks.TOY, "--population", 5, "--episodes", 2, "--evaluate-every", 2,
        "--evaluation-episodes", 3, "--confirm-episodes", 4, "--steps", 400, "--schedule", tmp_path / "stages.toml",
        "--init", tmp_path / "start.npz", task=tasks.TOY,
    )  # fmt: skip
    first = tmp_path / "kept.npz"
    (processes.runs / "first" / CONTROLLER).rename(first)
    (tmp_path / "start.npz").unlink()
    assert processes.call("runs", "delete", "first", "--yes", "--runs-dir", processes.runs)[0] == 0
    words = ("verify", "run", first, "--bundle", random_bundle.path, "--runs-dir", processes.runs, "--listen",
             processes.endpoint, "--beat", 0.2, "--json")  # fmt: skip
    again = processes.start(*words)
    processes.worker("--task", tasks.TOY, "--run", "kept-again")
    again.wait_for_event("generation", number=1)
    code, out = again.stop(signal.SIGINT)
    assert code == 130
    assert shlex.split(json.loads(out)["continue"])[-len(words) :] == [*map(str, words)]
    again = processes.start(*words)
    code, out = again.finish()
    answer = json.loads(out)
    assert (code, answer["same"], answer["run"]) == (0, True, "kept-again"), answer
    before, after = Controller.load(first), Controller.load(processes.runs / "kept-again" / CONTROLLER)
    assert after.sha256 == before.sha256
    assert after.provenance["validation_mean"] == before.provenance["validation_mean"]
    assert read_run_provenance(after).start == read_run_provenance(before).start
    with open_run(processes.runs, "kept-again") as run:
        assert len(run.history()) == read_run_provenance(before).generations
        assert len(run.settings.stages) == 2
    changed = {**before.provenance, "settings": {**before.provenance["settings"], "seed": 2}}
    moved = tmp_path / "moved.npz"
    Controller(shape, before.parameters, tasks.TOY, random_bundle.sha256, changed).save(moved)
    done = subprocess.run(
        [sys.executable, ROOT / "deploy" / "reproduce_evolution.py", moved, "--workers", "1", "--port",
         str(processes.port), "--runs-dir", processes.runs, "--task", tasks.TOY],
        env={**os.environ, "PYTHONPATH": str(ROOT), "DREAMFLEET_CACHE": str(processes.cache)}, capture_output=True,
        text=True, timeout=DEADLINE, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "NOT the same controller as the first time" in done.stdout
    assert "hosts and versions are equal" in done.stdout
