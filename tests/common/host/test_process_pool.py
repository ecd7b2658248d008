"""Work in several processes, of which some crash, leave others behind, or hang. Tests stall_watch.py."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool

import pytest

from dreamfleet.common.host.process_pool import map_in_processes
from tests.support import rough_tasks
from tests.support.processes import environment, started

pytestmark = pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="Linux")


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
        "from tests.common.host.test_process_pool import begin, hang\n"
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
