"""A world whose numbers explode pauses its run with the reason, and nothing is lost."""

import pytest

from dreamfleet.common.protocol.stop_kind import PauseKind
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
    coordinator.wait_for_event("paused")
    status = processes.status()
    assert (status["state"], status["pauses"]) == ("paused", [PauseKind.NO_ABLE_HOST])
    assert processes.call("stop", "test", "--connect", processes.endpoint)[0] == 0
    assert coordinator.finish()[0] == 130
    again = processes.resume()
    again.wait_for_event("paused")
    with open_run(processes.runs, "test") as run:
        assert run.result_count() == 0
