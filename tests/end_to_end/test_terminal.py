"""`status --watch` in a real terminal of 80 columns and 24 lines, beside a real fleet."""

import shlex
import subprocess
import time
import uuid

import pytest

from dreamfleet.common.host.processes import command
from tests.support import tasks
from tests.support.processes import DEADLINE, environment

pytestmark = pytest.mark.needs_programs("tmux")
NAMES = [f"a-host-of-thirty-letters-x{number:04d}" for number in range(2)]


class Terminal:
    """A tmux server of its own with one window."""

    def __init__(self, words, env):
        self._socket = f"dreamfleet-{uuid.uuid4().hex}"
        named = [f"{name}={value}" for name, value in env.items() if name not in ("COLUMNS", "TERM", "TMUX")]
        line = shlex.join(["env", "-u", "COLUMNS", *named, *words])
        self._call("new-session", "-d", "-x", "80", "-y", "24", f"{line}; printf over; cat")

    def wait_for(self, *texts):
        """The lines of the screen, once it has these texts."""
        deadline = time.monotonic() + DEADLINE
        while not all(text in (seen := self._call("capture-pane", "-p")) for text in texts):
            assert time.monotonic() < deadline, seen
        return seen.splitlines()

    def end(self):
        subprocess.run(["tmux", "-L", self._socket, "kill-server"], check=False, capture_output=True)

    def _call(self, *words):
        done = subprocess.run(["tmux", "-L", self._socket, *words], check=True, capture_output=True, text=True)
        return done.stdout


@pytest.fixture
def terminal(processes):
    words = command("status", "--connect", processes.endpoint, "--watch")
    made = Terminal(words, environment(processes.cache))
    yield made
    made.end()


@pytest.mark.slow
def test_a_watcher_sees_the_whole_run_in_24_lines_and_at_last_its_end(processes, terminal, small):
    coordinator = processes.coordinator(*small, "--episodes", 2, "--generations", 4)
    terminal.wait_for("waiting for workers")
    for name in NAMES:
        processes.worker("--task", tasks.SLOW_TOY, "--name", name)
    seen = terminal.wait_for(*NAMES)
    assert max(map(len, seen)) <= 80
    assert not any("…" in line for line in seen)
    assert coordinator.finish()[0] == 0
    last = terminal.wait_for("over")
    assert last[0].startswith("╭─ test · ")
    assert "4 generations" in last[1]
