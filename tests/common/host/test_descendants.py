"""What processes leave behind, and work in several processes, of which some crash or hang.
Tests process_pool.py and stall_watch.py."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool

import pytest

from dreamfleet.common.host.descendants import VARIABLE, Descendants
from dreamfleet.common.host.process_pool import map_in_processes
from tests.support import rough_tasks
from tests.support.processes import ends, environment, started

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


def begin():
    pass


def crash(_item):
    rough_tasks.hold_copies()
    if os.fork() == 0:
        rough_tasks.linger()
    rough_tasks.wait_for_one_left()
    os.kill(os.getpid(), signal.SIGKILL)


def write_later(path):
    time.sleep(0.5)
    path.touch()


def hang(folder):
    (folder / str(os.getpid())).touch()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    time.sleep(600)


@pytest.mark.slow
def test_a_crash_is_noticed_although_another_process_holds_the_pipes(tmp_path, monkeypatch):
    monkeypatch.setenv(rough_tasks.FOLDER, str(tmp_path))
    with pytest.raises(BrokenProcessPool):
        list(map_in_processes(1, begin, (), crash, [0]))
    (left,) = tmp_path.iterdir()
    while (path := f"/proc/{left.name}/stat") and os.path.exists(path):  # noqa: PTH110
        time.sleep(0.01)


def test_each_result_comes_and_closed_early_it_waits_for_what_runs(tmp_path):
    assert set(map_in_processes(2, begin, (), abs, [-1, 2, -3])) == {1, 2, 3}
    results = map_in_processes(2, begin, (), write_later, [tmp_path / str(number) for number in range(20)])
    assert next(results) is None
    results.close()
    assert 2 <= len(list(tmp_path.iterdir())) < 20


def test_an_interrupt_ends_processes_that_hang(tmp_path):
    script = (
        "import pathlib, sys\n"
        "from dreamfleet.common.host.process_pool import map_in_processes\n"
        "from tests.common.host.test_descendants import begin, hang\n"
        "if __name__ == '__main__':\n"
        "    list(map_in_processes(2, begin, (), hang, [pathlib.Path(sys.argv[1])] * 2))\n"
    )
    file = tmp_path / "script.py"
    file.write_text(script)
    (folder := tmp_path / "hanging").mkdir()
    command = [sys.executable, file, folder]
    with started(command, env=environment(tmp_path), stderr=subprocess.DEVNULL) as parent:
        while len(hanging := list(folder.iterdir())) < 2:
            time.sleep(0.01)
        pidfds = [os.pidfd_open(int(each.name)) for each in hanging]
        parent.send_signal(signal.SIGINT)
        assert parent.wait(60)
    for each in pidfds:
        with pytest.raises(ProcessLookupError):
            signal.pidfd_send_signal(each, 0)
        os.close(each)
