import json
import sqlite3
from contextlib import closing

import pytest

from dreamfleet.common.runs.run_paths import JOURNAL
from tests.support import tasks


@pytest.fixture
def finished_run(processes, random_bundle):
    coordinator = processes.coordinator(
        "--bundle", random_bundle.path, "--task", tasks.TOY, "--population", 4, "--episodes", 2, "--generations", 1,
        "--evaluate-every", 0,
    )  # fmt: skip
    processes.worker("--task", tasks.TOY, "--exit-when-done")
    assert coordinator.finish()[0] == 0
    return processes.runs / "test"


def test_a_fitness_that_differs_from_the_stored_one_is_reported_and_exits_1(processes, finished_run):
    replay = ("replay", "test", "--runs-dir", processes.runs, "--candidate", "0/1")
    code, out, _ = processes.call(*replay)
    assert (code, out.count("same bits")) == (0, 2)
    with closing(sqlite3.connect(finished_run / JOURNAL)) as connection, connection:
        connection.execute("UPDATE result SET fitness = fitness + 1e-9 WHERE candidate = 1 AND episode = 1")
    connection.close()
    code, out, _ = processes.call(*replay)
    assert (code, out.count("same bits"), out.count("DIFFERS")) == (1, 1, 1)
    code, _, err = processes.call("replay", "test", "--runs-dir", processes.runs, "--candidate", "5/0")
    assert code == 1
    assert "candidate 5/0" in err


def test_results_of_another_host_class_are_counted_and_optionally_compared(processes, finished_run):
    with closing(sqlite3.connect(finished_run / JOURNAL)) as connection, connection:
        connection.execute("UPDATE result SET fitness = fitness + 0.5, host_class = 'there' WHERE episode = 1")
    connection.close()
    replay = ("replay", "test", "--runs-dir", processes.runs, "--candidate", "0/1")
    code, out, err = processes.call(*replay)
    assert (code, out.count("same bits"), out.count("not checkable here: of class there")) == (0, 1, 1)
    assert "1 of 2 episodes were scored by hosts of another class" in err
    found = json.loads(processes.call(*replay, "--json")[1])
    assert (found["identical"], found["unchecked"]) == (False, 1)
    code, out, err = processes.call(*replay, "--tolerance", 1)
    assert (code, out.count("within 1, of class there"), err) == (0, 1, "")
    assert processes.call(*replay, "--tolerance", 0.25)[0] == 1
