"""Whole workers whose environments leave processes behind: they go on, and two signals end them in any case."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support import rough_tasks, tasks
from tests.support.processes import environment, started

pytestmark = pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="Linux")


@pytest.fixture
def left(tmp_path, monkeypatch):
    folder = tmp_path / "left"
    folder.mkdir()
    monkeypatch.setenv(rough_tasks.FOLDER, str(folder))
    return folder


def serve(processes, bundle, task, *more):
    name = task if isinstance(task, str) else rough_tasks.name_of(task)
    coordinator = processes.coordinator("--bundle", bundle.path, "--task", name, "--population", 4, "--episodes", 1)
    worker = processes.worker("--task", name, *more)
    worker.wait_for_event("joined")
    return coordinator, worker


def wait_for_one(folder):
    while not (found := list(folder.iterdir())):
        time.sleep(0.02)
    return os.pidfd_open(int(found[0].name))


def wait_gone(pidfd):
    while True:
        try:
            signal.pidfd_send_signal(pidfd, 0)
        except ProcessLookupError:
            os.close(pidfd)
            return
        time.sleep(0.02)


@pytest.mark.slow
def test_a_crash_behind_a_forked_process_pauses_the_run_with_its_reason(processes, random_bundle, left):
    coordinator, worker = serve(processes, random_bundle, rough_tasks.Forking)
    assert "SIGSEGV" in coordinator.wait_for_event("paused")["message"]
    worker.popen.send_signal(signal.SIGTERM)
    assert worker.finish()[0] == 0


@pytest.mark.slow
def test_two_signals_end_it_and_what_its_environment_left(processes, random_bundle, left):
    _, worker = serve(processes, random_bundle, rough_tasks.ForkingAndHanging)
    pidfd = wait_for_one(left)
    worker.popen.send_signal(signal.SIGINT)
    worker.wait_for_event("draining")
    worker.popen.send_signal(signal.SIGINT)
    assert worker.finish(60)[0] == 0
    wait_gone(pidfd)


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


def test_sigterm_to_all_its_processes_drains_it(processes, random_bundle):
    """As systemd stops a service: no child ends before its episode."""
    _, worker = serve(processes, random_bundle, tasks.SLOW_TOY)
    for pid in family_of(worker.popen.pid):
        os.kill(pid, signal.SIGTERM)
    assert worker.finish(120)[0] == 0
    assert not [line for line in worker.lines if line.facts.get("level") == "warning"]


def family_of(parent):
    """The process and its children."""
    children = Path(f"/proc/{parent}/task").glob("*/children")
    return [parent, *(int(each) for listed in children for each in listed.read_text().split())]
