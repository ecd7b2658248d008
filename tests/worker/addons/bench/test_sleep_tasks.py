"""The benchmark's tasks are found by name, as a worker finds them."""

import pytest

from dreamfleet.worker.addons.bench.sleep_tasks import HALF_SECOND_TASK, NULL_TASK, SLEEP_TASK
from dreamfleet.worker.tasks.registry import find_task


@pytest.mark.parametrize("name", [SLEEP_TASK, NULL_TASK, HALF_SECOND_TASK])
def test_a_worker_finds_it(name):
    assert find_task(name).name == name
