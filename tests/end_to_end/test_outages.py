"""Workers whose coordinator is out of sight for a while, and what a run says of workers that left.
Tests coordinator/addons/runs/story_verb.py."""

import json
import time

import pytest

from tests.support import tasks
from tests.support.processes import DEADLINE, ROOT
from tests.support.relay import Relay

OUTAGE = 8.0  # seconds; a worker with --exit-when-done once left after five
SETTINGS = ("--task", tasks.SLOW_TOY, "--population", 4, "--episodes", 2, "--evaluate-every", 0, "--generations", 3)
ENVIRONMENT = """
import gymnasium
gymnasium.register("There-v0", entry_point="gymnasium.envs.classic_control:CartPoleEnv", max_episode_steps=50)
"""


@pytest.fixture
def relay(processes):
    made = Relay(processes.port)
    yield made
    made.close()


@pytest.mark.slow
def test_a_cut_link_costs_neither_the_worker_nor_its_results(processes, random_bundle, relay):
    coordinator = processes.coordinator("--bundle", random_bundle.path, *SETTINGS)
    worker = processes.worker("--task", tasks.SLOW_TOY, "--exit-when-done", endpoint=relay.endpoint)
    coordinator.wait_for_event("generation", number=0)
    relay.hold()
    relay.cut()
    worker.wait_for_event("coordinator gone")
    time.sleep(OUTAGE)
    assert worker.popen.poll() is None
    relay.release()
    worker.wait_for_event("coordinator back")
    assert coordinator.finish()[0] == 0
    assert worker.finish()[0] == 0
    assert worker.events("left", run="test")


@pytest.mark.slow
def test_a_run_says_why_its_worker_left_and_the_worker_in_one_line(processes):
    there = processes.folder / "there"
    there.mkdir()
    (there / "its_module.py").write_text(ENVIRONMENT)
    coordinator = processes.start(
        "coordinator", "--run", "test", "--runs-dir", processes.runs, "--listen", processes.endpoint,
        "--task", "gym:its_module:There-v0", "--population", 4, "--generations", 1,
        inside=("env", f"PYTHONPATH={ROOT}:{there}"),
    )  # fmt: skip
    coordinator.wait_for_event("begin")
    code, _, err = processes.call(
        "worker", "--connect", processes.endpoint, "--slots", 1, "--task", "gym:its_module:There-v0"
    )
    assert code == 1
    assert "Traceback" not in err
    why = "its_module:There-v0"
    assert why in err.splitlines()[-1]
    coordinator.wait_for_event("left")
    deadline = time.monotonic() + DEADLINE
    while not (status := processes.status())["workers"].get("left"):
        assert time.monotonic() < deadline
    (row,) = status["worker_list"]
    assert (row["state"], status["workers"]["lost"]) == ("left", 0)
    assert why in row["reason"]
    _, out, _ = processes.call("status", "test", "--connect", processes.endpoint)
    assert "left" in out
    assert "none has joined" not in out
    _, out, _ = processes.call("story", "test", "--connect", processes.endpoint, "--json")
    assert why in json.loads(out)[-1]["why"]
