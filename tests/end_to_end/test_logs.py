"""What a coordinator and its workers say of one another."""

import json
import shlex

import pytest

from tests.support import tasks

pytestmark = pytest.mark.timeout(120)


def test_a_fleets_log_is_json_where_it_is_asked_for_and_tells_how_to_start_a_worker(processes, random_bundle):
    coordinator = processes.coordinator(
        "--bundle", random_bundle.path, "--population", 4, "--episodes", 2, "--evaluate-every", 0,
        "--task", tasks.TOY, "--generations", 100000, "--log-format", "auto",
    )  # fmt: skip
    told = json.loads(coordinator.wait_for("no worker is there"))
    assert told["event"] == "no worker"
    program, *words = shlex.split(told["command"])
    assert program == "dreamfleet"
    worker = processes.start(*words, "--slots", "1", "--task", tasks.TOY)
    closed = json.loads(coordinator.wait_for("generation 0: mean"))
    assert (closed["event"], closed["number"], closed["level"]) == ("generation", 0, "info")
    coordinator.popen.kill()
    assert "this worker waits for that run alone" in worker.wait_for("the coordinator of run test is gone")
