import os
import queue
import signal
import sys

import pytest

from dreamfleet.common.host.child import CommandChild, FunctionChild
from tests.support.processes import DEADLINE

pytestmark = pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="Linux")
DEAF = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); signal.pause()"


def echo(pipe, number):
    pipe.send((2 * number, os.getpgid(0)))
    pipe.send(pipe.recv())


def test_a_function_talks_to_its_parent_and_its_end_is_heard():
    messages = queue.SimpleQueue()
    with FunctionChild(echo, 21, on_message=messages.put) as child:
        assert messages.get(timeout=DEADLINE) == (42, child.pid), "in a session of its own"
        assert child.memory > 0
        assert child.send("again")
        assert [messages.get(timeout=DEADLINE) for _ in range(2)] == ["again", None]
        assert child.wait(DEADLINE)
        assert child.exit_code == 0


@pytest.mark.parametrize("is_own", [True, False])
def test_a_command_that_ignores_sigterm_is_killed(is_own):
    child = CommandChild([sys.executable, "-S", "-c", DEAF], is_own=is_own, stdout=-1)
    with child.popen.stdout as printed:
        printed.readline()
        child.ask_to_end()
        assert not child.wait(0.01)
        assert child.end(0.01)
    assert child.exit_code == -signal.SIGKILL
