import sqlite3

import pytest

from dreamfleet.common.runs import JOURNAL
from tests.support import tasks

pytestmark = pytest.mark.timeout(60)


@pytest.fixture
def finished_run(processes, random_bundle):
    coordinator = processes.coordinator(
        "--bundle", random_bundle.path, "--task", tasks.TOY, "--population", 4, "--episodes", 2, "--generations", 1,
        "--evaluate-every", 0,
    )  # fmt: skip
    processes.worker("--task", tasks.TOY, "--exit-when-done")
    assert coordinator.finish()[0] == 0
    return processes.runs / "test"


def test_a_fitness_that_is_not_what_was_stored_is_told_and_exits_1(processes, finished_run):
    replay = ("replay", "test", "--runs-dir", processes.runs, "--candidate", "0/1")
    code, out, _ = processes.call(*replay)
    assert (code, out.count("same bits")) == (0, 2)
    with sqlite3.connect(finished_run / JOURNAL) as connection:
        connection.execute("UPDATE result SET fitness = fitness + 1e-9 WHERE candidate = 1 AND episode = 1")
    connection.close()
    code, out, _ = processes.call(*replay)
    assert (code, out.count("same bits"), out.count("DIFFERS")) == (1, 1, 1)
    code, _, err = processes.call("replay", "test", "--runs-dir", processes.runs, "--candidate", "5/0")
    assert code == 1
    assert "candidate 5/0" in err
