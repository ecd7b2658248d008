"""An environment that misbehaves in its process: a verb goes on, answers where it was, and leaves nothing behind."""

import json
import signal
import subprocess
from pathlib import Path

import pytest

from dreamfleet.common.host.processes import command
from dreamfleet.worker.worlds.gym.task import GymTask
from tests.support import pixel_fakes
from tests.support.processes import DEADLINE, environment, runs, until

RUDE = f"{pixel_fakes.MODULE}:Rude-v0"


def rude(**arguments):
    return GymTask(RUDE).with_options(json.dumps({"environment": arguments}))


@pytest.mark.parametrize("close", ["raises", "exits"])
def test_what_it_does_as_it_is_made_and_closed_is_undone(close, capfd, caplog):
    folder, handlers = Path.cwd(), [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    world = rude(close=close).world
    assert (world.actions.outputs, world.action_names, world.frames_per_second) == (3, (), 30)
    assert Path.cwd() == folder
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == handlers
    out, err = capfd.readouterr()
    assert (out, err.count("made")) == ("", 4)
    assert "Rude" in caplog.text
    assert "\n" not in caplog.messages[-1]


def test_drives_are_collected_where_the_verb_was_told_and_its_answer_is_whole(tmp_path):
    born = tmp_path / "born"
    words = ("collect", "--data", "data", "--task", f"gym:{RUDE}", "--environment", f"child={born}")
    done = subprocess.run(
        command(*words, "--episodes", 2, "--steps", 4, "--jobs", 2, "--json"),
        cwd=tmp_path, env=environment(tmp_path), capture_output=True, text=True, timeout=DEADLINE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["new_episodes"] == 2
    assert sorted(each.name for each in (tmp_path / "data" / "episodes").iterdir()) == ["000000.npz", "000001.npz"]
    children = [int(each) for each in born.read_text().split()]
    assert children
    until(lambda: not any(map(runs, children)), "a process of the environment outlives the verb")
