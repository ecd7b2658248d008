"""The promise: who scored, and who died meanwhile, changes no bit."""

import os
import signal

import pytest

from tests.support.same_bits import EPISODES, SETTINGS, outcome

DREAMT = ("--task", "dream", "--horizon", 100, "--evaluate-every", 2, "--evaluation-episodes", 2,
          "--confirm-episodes", 2)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("flags", [("--evaluate-every", 0), DREAMT], ids=["driven", "dreamt"])
def test_one_worker_and_three_of_which_one_is_killed_give_the_same_bits(processes, flags):
    coordinator = processes.coordinator(*SETTINGS, *flags, name="alone")
    worker = processes.worker("--run", "alone")
    assert coordinator.finish()[0] == 0
    worker.end()
    coordinator = processes.coordinator(*SETTINGS, *flags, name="three")
    workers = [processes.worker("--run", "three", "--name", f"w{number}") for number in range(3)]
    coordinator.wait_for_event("generation", number=0)
    os.kill(workers[1].popen.pid, signal.SIGKILL)  # it has jobs of the next one by now
    assert coordinator.finish()[0] == 0
    assert outcome(processes, "alone") == outcome(processes, "three")
    code, out, err = processes.call("verify", "candidate", "alone", "--runs-dir", processes.runs, "--candidate", "2/3")
    assert (code, out.count("same bits")) == (0, EPISODES), err
