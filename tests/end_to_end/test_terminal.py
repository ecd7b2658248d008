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

    def __init__(self, words, env, width, height):
        self._socket = f"dreamfleet-{uuid.uuid4().hex}"
        size = ("-x", str(width), "-y", str(height))
        named = [f"{name}={value}" for name, value in env.items() if name not in ("COLUMNS", "TERM", "TMUX")]
        line = shlex.join(["env", "-u", "COLUMNS", *named, *words])
        self._call("new-session", "-d", *size, f"{line}; printf over; cat")

    def lines(self):
        return self._call("capture-pane", "-p").splitlines()

    def wait_for(self, *texts):
        deadline = time.monotonic() + DEADLINE
        while not all(text in (seen := "\n".join(self.lines())) for text in texts):
            assert time.monotonic() < deadline, seen
        return seen.splitlines()

    def end(self):
        subprocess.run(["tmux", "-L", self._socket, "kill-server"], check=False, capture_output=True)

    def _call(self, *words):
        done = subprocess.run(["tmux", "-L", self._socket, *words], check=True, capture_output=True, text=True)
        return done.stdout


@pytest.fixture
def watch(processes):
    terminals = []

    def begin(width, height):
        words = command("status", "--connect", processes.endpoint, "--watch")
        terminals.append(Terminal(words, environment(processes.cache), width, height))
        return terminals[-1]

    yield begin
    for each in terminals:
        each.end()


@pytest.mark.slow
def test_a_watcher_sees_the_whole_run_in_24_lines_and_at_last_its_end(processes, watch, random_bundle):
    coordinator = processes.coordinator(
        "--bundle", random_bundle.path, "--population", 4, "--episodes", 2, "--evaluate-every", 0,
        "--task", tasks.SLOW_TOY, "--generations", 4,
    )  # fmt: skip
    terminal = watch(80, 24)
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
