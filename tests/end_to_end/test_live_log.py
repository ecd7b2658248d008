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


def followers(process):
    """The processes that a coordinator started to write curves."""
    children = Path(f"/proc/{process.popen.pid}/task/{process.popen.pid}/children").read_text().split()
    return [int(each) for each in children if "spawn_main" in Path(f"/proc/{each}/cmdline").read_text()]


@pytest.mark.slow
def test_curves_go_on_after_a_kill_and_stall_nothing(processes, random_bundle, monkeypatch):
    """The last of three lives stops its follower, which holds up neither generations nor, for long, the run's end."""
    monkeypatch.setenv("DREAMFLEET_NETWORK_LOG_TO", "tensorboard")
    settings = ("--bundle", random_bundle.path, "--population", 4, "--episodes", 1, "--evaluate-every", 5,
                "--evaluation-episodes", 2, "--task", tasks.TOY)  # fmt: skip
    processes.worker("--task", tasks.TOY)
    board = processes.runs / "test" / "tensorboard"
    life = processes.coordinator(*settings, "--generations", 100000)
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


def test_a_follower_that_stands_still_holds_up_no_generation(processes, random_bundle, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_NETWORK_LOG_TO", "tensorboard")
    life = processes.coordinator("--bundle", random_bundle.path, "--population", 4, "--episodes", 1,
                                 "--evaluate-every", 0, "--task", tasks.TOY, "--generations", 100000)  # fmt: skip
    (follower,) = followers(life)
    os.kill(follower, signal.SIGSTOP)
    processes.worker("--task", tasks.TOY)
    life.wait_for_event("generation", times=20)
    os.kill(follower, signal.SIGKILL)
    life.wait_for_event("curves ended")
    life.wait_for_event("generation", times=2)
