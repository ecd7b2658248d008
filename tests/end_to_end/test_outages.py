"""What a run says of workers that left.
Tests coordinator/addons/runs/story_verb.py."""

import json

import pytest

from tests.support.processes import ROOT, until

ENVIRONMENT = """
import gymnasium
gymnasium.register("There-v0", entry_point="gymnasium.envs.classic_control:CartPoleEnv", max_episode_steps=50)
"""


@pytest.mark.slow
def test_a_run_says_why_its_worker_left_and_the_worker_in_one_line(processes):
    there = processes.folder / "there"
    there.mkdir()
    (there / "its_module.py").write_text(ENVIRONMENT)
    why = "its_module:There-v0"
    task = ("--task", f"gym:{why}")
    inside = ("env", f"PYTHONPATH={ROOT}:{there}")
    coordinator = processes.coordinator(*task, "--population", 4, "--generations", 1, inside=inside)
    code, _, err = processes.call("worker", "--connect", processes.endpoint, "--slots", 1, *task)
    assert (code, why in err.splitlines()[-1], "Traceback" in err) == (1, True, False), err
    coordinator.wait_for_event("left")
    until(lambda: processes.status()["workers"].get("left"))
    status = processes.status()
    (row,) = status["worker_list"]
    assert (row["state"], status["workers"]["lost"]) == ("left", 0)
    assert why in row["reason"]
    _, out, _ = processes.call("status", "test", "--connect", processes.endpoint)
    assert "left" in out
    assert "none has joined" not in out
    _, out, _ = processes.call("story", "test", "--connect", processes.endpoint, "--json")
    assert why in json.loads(out)[-1]["why"]
