"""A run whose curves go to TensorBoard while it goes on."""

import os
import signal
from collections import Counter
from pathlib import Path

import pytest

from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.runs.export import scalars_of
from tests.support import tasks
from tests.support.events import scalars


@pytest.mark.slow
def test_curves_go_on_after_a_kill_and_stall_nothing(processes, small, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_NETWORK_LOG_TO", "tensorboard")
    processes.worker("--task", tasks.TOY)
    board = processes.runs / "test" / "tensorboard"
    judged = ("--evaluate-every", 5, "--evaluation-episodes", 2)
    life = processes.coordinator(*small, "--task", tasks.TOY, *judged)
    monkeypatch.delenv("DREAMFLEET_NETWORK_LOG_TO")  # the run keeps the setting
    for _ in range(2):
        while not any(len(points) > 3 for points in scalars(board).values()):
            life.wait_for_event("generation")
        os.kill(life.popen.pid, signal.SIGKILL)
        life.popen.wait()
        life = processes.resume()
    life.wait_for_event("generation", times=3)
    life.popen.send_signal(signal.SIGTERM)
    life.finish()
    last = processes.resume("test", "--minutes", "0.001")
    assert last.finish()[0] == 0
    with RunFolder(processes.runs / "test") as run:
        wanted = Counter((name.replace("__", "/"), step) for step, each in scalars_of(run) for name in each)
    found = Counter((name, step) for name, points in scalars(board).items() for step, _ in points)
    assert found == wanted


def test_a_follower_that_stands_still_holds_up_no_generation(processes, small, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_NETWORK_LOG_TO", "tensorboard")
    life = processes.coordinator(*small, "--task", tasks.TOY)
    children = Path(f"/proc/{life.popen.pid}/task/{life.popen.pid}/children").read_text().split()
    (follower,) = [int(each) for each in children if "spawn_main" in Path(f"/proc/{each}/cmdline").read_text()]
    os.kill(follower, signal.SIGSTOP)
    processes.worker("--task", tasks.TOY)
    life.wait_for_event("generation", times=20)
    os.kill(follower, signal.SIGKILL)
    life.wait_for_event("curves ended")
    life.wait_for_event("generation", times=2)
