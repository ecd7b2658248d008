"""The promise: who scored, and who died meanwhile, changes no bit."""

import os
import signal

import pytest

from tests.support.same_bits import EPISODES, SETTINGS, outcome


def run_alone(processes):
    coordinator = processes.coordinator(*SETTINGS, "--evaluate-every", 0, name="alone")
    worker = processes.worker("--run", "alone")
    code, _ = coordinator.finish()
    assert code == 0
    worker.end()
    return outcome(processes, "alone")


def run_with_a_death(processes):
    """Three workers; one is killed while it scores, in the middle of the second generation."""
    coordinator = processes.coordinator(*SETTINGS, "--evaluate-every", 0, name="three")
    workers = [processes.worker("--run", "three", "--name", f"w{number}") for number in range(3)]
    coordinator.wait_for_event("generation", number=0)
    while (generation := processes.statuses()[0].generation).episodes_done == generation.episodes:
        pass  # between two generations
    os.kill(workers[1].popen.pid, signal.SIGKILL)
    code, _ = coordinator.finish()
    assert code == 0
    return outcome(processes, "three")


@pytest.mark.slow
def test_one_worker_and_three_of_which_one_is_killed_give_the_same_bits(processes):
    alone, three = run_alone(processes), run_with_a_death(processes)
    assert alone == three
    code, out, err = processes.call("verify", "candidate", "alone", "--runs-dir", processes.runs, "--candidate", "2/3")
    assert code == 0, err
    assert out.count("same bits") == EPISODES
