import os
import signal
import subprocess
import sys

import pytest

from dreamfleet.common.host.descendants import VARIABLE, Descendants
from tests.support.processes import ends, environment

pytestmark = pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="Linux")

# A process that leaves its parent and session, ignores SIGTERM, and writes its id.
DAEMON = (
    "import os, signal, sys, time\n"
    "if os.fork() == 0:\n"
    "    os.setsid()\n"
    "    if os.fork() == 0:\n"
    "        signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
    "        print(os.getpid(), flush=True)\n"
    "        time.sleep(600)\n"
    "    os._exit(0)\n"
    "os.wait()\n"
)


def start_daemon(where, **more):
    with where.starting():
        child = subprocess.Popen([sys.executable, "-S", "-c", DAEMON], stdout=subprocess.PIPE, text=True, **more)
    pid = int(child.stdout.readline())
    child.wait()
    child.stdout.close()
    return os.pidfd_open(pid)


def test_a_daemon_ends_and_another_childs_does_not():
    ours, others = Descendants(), Descendants()
    ends_now, lives = start_daemon(ours), start_daemon(others)
    ours.kill()
    assert ends(ends_now)
    signal.pidfd_send_signal(lives, 0)
    others.kill()
    assert ends(lives)


def test_what_clears_the_environment_meanwhile_is_no_error():
    with Descendants().starting():
        del os.environ[VARIABLE]
    assert VARIABLE not in os.environ


def test_a_process_of_the_session_without_the_mark_ends():
    ours = Descendants()
    script = "env -i /bin/sh -c 'echo $$; exec /bin/sleep 600' & wait"
    with ours.starting():
        child = subprocess.Popen(["/bin/sh", "-c", script], stdout=subprocess.PIPE, text=True, start_new_session=True)
    ours.add_session(child.pid)
    pidfd = os.pidfd_open(int(child.stdout.readline()))
    ours.kill()
    assert ends(pidfd)
    child.wait()
    child.stdout.close()
    ours.forget()


KILL_GUARD = (
    "with descendants.Descendants().starting():\n    pass\ndescendants._guard.kill()\ndescendants._guard.wait()\n"
)


@pytest.mark.parametrize(
    ("before", "number"), [("", signal.SIGKILL), ("", signal.SIGTERM), (KILL_GUARD, signal.SIGKILL)]
)
def test_daemons_end_with_the_process_that_started_their_parent(tmp_path, before, number):
    script = (
        "import subprocess, sys, time\n"
        "from dreamfleet.common.host import descendants\n"
        f"{before}"
        "with descendants.Descendants().starting():\n"
        f"    subprocess.Popen([sys.executable, '-S', '-c', {DAEMON!r}])\n"
        "time.sleep(600)\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", script], env=environment(tmp_path), stdout=subprocess.PIPE, text=True
    )
    pidfd = os.pidfd_open(int(parent.stdout.readline()))
    parent.send_signal(number)
    parent.wait()
    assert ends(pidfd)
    parent.stdout.close()
