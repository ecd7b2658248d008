"""A world whose numbers explode pauses its run with the reason, and nothing is lost."""

import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks


@pytest.mark.slow
@pytest.mark.parametrize("task", [tasks.EXPLODING, tasks.ENDLESS])
def test_extreme_numbers_pause_the_run_with_their_reason_and_it_can_be_continued(processes, random_bundle, task):
    coordinator = processes.coordinator(
        "--bundle", random_bundle.path, "--task", task, "--population", 3, "--episodes", 1, "--evaluate-every", 0,
        "--generations", 2,
    )  # fmt: skip
    processes.worker("--task", task)
    said = coordinator.wait_for("paused: ")
    assert "failed on one worker" in said
    assert "which must lie within" in said or "steps, more than" in said
    assert processes.status()["state"] == "paused"
    assert processes.call("stop", "test", "--connect", processes.endpoint)[0] == 0
    assert coordinator.finish()[0] == 130
    again = processes.start("coordinator", "--resume", "test", "--runs-dir", processes.runs)
    again.wait_for("paused: ")
    with open_run(processes.runs, "test") as run:
        assert run.result_count() == 0
