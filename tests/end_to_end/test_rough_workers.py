"""Whole workers whose environments leave processes behind: they go on, and two signals end them in any case."""

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support import rough_tasks, tasks
from tests.support.processes import DEADLINE, environment, started, until

pytestmark = pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="Linux")


@pytest.fixture
def left(tmp_path, monkeypatch):
    folder = tmp_path / "left"
    folder.mkdir()
    monkeypatch.setenv(rough_tasks.FOLDER, str(folder))
    return folder


def serve(processes, small, name):
    coordinator = processes.coordinator(*small, "--task", name)
    worker = processes.worker("--task", name)
    worker.wait_for_event("joined")
    return coordinator, worker


@pytest.mark.slow
def test_a_crash_behind_a_forked_process_pauses_the_run_with_its_reason(processes, small, left):
    coordinator, worker = serve(processes, small, rough_tasks.name_of(rough_tasks.Forking))
    assert "SIGSEGV" in coordinator.wait_for_event("paused")["message"]
    worker.popen.send_signal(signal.SIGTERM)
    assert worker.finish()[0] == 0


@pytest.mark.slow
def test_two_signals_end_it_and_what_its_environment_left(processes, small, left):
    _, worker = serve(processes, small, rough_tasks.name_of(rough_tasks.ForkingAndHanging))
    until(lambda: list(left.iterdir()))
    pidfd = os.pidfd_open(int(next(left.iterdir()).name))
    worker.popen.send_signal(signal.SIGINT)
    worker.wait_for_event("draining")
    worker.popen.send_signal(signal.SIGINT)
    assert worker.finish(60)[0] == 0
    assert select.select([pidfd], [], [], DEADLINE)[0], "it has ended"
    os.close(pidfd)


@pytest.mark.slow
def test_two_signals_end_a_process_whose_main_thread_is_stuck_in_native_code(tmp_path):
    script = (
        "import ctypes\n"
        "from dreamfleet.common.host.stop_signals import call_on_signals\n"
        "call_on_signals(lambda: print('heard', flush=True))\n"
        "print('ready', flush=True)\n"
        "libc = ctypes.CDLL(None)\n"
        "libc.pthread_mutex_lock(mutex := ctypes.create_string_buffer(64))\n"
        "libc.pthread_mutex_lock(mutex)\n"
    )
    command = [sys.executable, "-c", script]
    with started(command, env=environment(tmp_path), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "heard\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 1


def test_sigterm_to_all_its_processes_drains_it(processes, small):
    """As systemd stops a service: no child ends before its episode."""
    _, worker = serve(processes, small, tasks.SLOW_TOY)
    children = Path(f"/proc/{worker.popen.pid}/task").glob("*/children")
    for pid in (worker.popen.pid, *(int(each) for listed in children for each in listed.read_text().split())):
        os.kill(pid, signal.SIGTERM)
    assert worker.finish(120)[0] == 0
    assert not [line for line in worker.lines if line.facts.get("level") == "warning"]
