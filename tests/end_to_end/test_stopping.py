"""Verbs that work for long, or start others, and Ctrl-C or SIGTERM: what is there is kept and named, nobody is left.
Tests worker/service/membership.py."""

import os
import signal
import subprocess
import sys
import time

import av
import psutil
import pytest

from dreamfleet.worker.training.data.dataset import existing_episodes
from tests.support import tasks
from tests.support.processes import environment, started, until


@pytest.fixture(params=[signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)])
def number(request):
    return request.param


def stopped(process, number, there):
    """Send the signal to the whole group, as a terminal does, once something is `there`; what it said last."""
    while not there():
        assert process.popen.poll() is None, "".join(process.lines)
    os.killpg(process.popen.pid, number)
    code, _ = process.finish()
    assert code == 130
    assert "Traceback" not in "".join(process.lines)
    return process.lines[-1]


@pytest.mark.slow
def test_a_recording_can_be_played(processes, tmp_path, number):
    out = tmp_path / "drive.mp4"
    recording = processes.start("record", "--controller", "tiny", "--out", out)
    said = stopped(
        recording, number, lambda: any(each.is_file() and each.stat().st_size for each in tmp_path.rglob("*"))
    )
    with av.open(str(out)) as container:
        frames = len(list(container.decode(container.streams.video[0])))
    assert 0 < frames < 1000
    assert all(datum in said for datum in (str(out), f" {frames} "))


@pytest.mark.slow
def test_a_collection_keeps_its_episodes_and_counts_them(processes, tmp_path, number):
    flags = ("--episodes", 1000, "--jobs", 2)
    collecting = processes.start("collect", "--data", tmp_path, *flags)
    said = stopped(collecting, number, lambda: len(existing_episodes(tmp_path)) >= 2)
    kept = len(existing_episodes(tmp_path))
    assert all(datum in said for datum in (str(tmp_path), f" {kept} ", "1000"))
    assert [path.name for path in (tmp_path / "episodes").iterdir() if path not in existing_episodes(tmp_path)] == []


IGNORING = ("sh", "-c", 'trap "" INT; exec "$@"', "sh")  # as a shell starts the background jobs of a script


@pytest.fixture
def words(processes, random_bundle, tmp_path):
    """The command line of a verb that would work for hours."""
    place = ("--runs-dir", processes.runs, "--port", processes.port, "--bundle", random_bundle.path)
    collected = ("--collect-flags", "--episodes 10000 --steps 20")
    return {
        "demo": ("demo", "--run", "demo", *place, "--workers", 1, "--no-page", "--dream-minutes", 300),
        "pipeline": ("pipeline", "--data", tmp_path / "data", "--jobs", 1, "--preset", "tiny", *collected),
    }


def of(cache):
    """The ids of all processes that were started for this test: each has its cache in its environment."""
    started = psutil.process_iter(["environ"])
    return {each.pid for each in started if (each.info["environ"] or {}).get("DREAMFLEET_CACHE") == str(cache)}


def wait_for_others(process, cache):
    """Until it has started another process."""
    while not of(cache) - {process.popen.pid}:
        assert process.popen.poll() is None, "".join(process.lines)
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("verb", "number"), [("demo", signal.SIGINT), ("pipeline", signal.SIGTERM)])
def test_it_ends_however_it_was_started(processes, words, verb, number):
    process = processes.start(*words[verb], inside=IGNORING)
    wait_for_others(process, processes.cache)
    process.popen.send_signal(number)
    assert process.finish()[0] == 130, "".join(process.lines)
    assert "Traceback" not in "".join(process.lines)
    until(lambda: not of(processes.cache))


def test_what_judges_ends_with_an_evaluation_that_is_killed(processes):
    """As by `demo`, which ends while it judges."""
    process = processes.start("evaluate", "--controller", "tiny", "--episodes", 1000, "--jobs", 2)
    wait_for_others(process, processes.cache)
    process.popen.kill()
    until(lambda: not of(processes.cache))


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
    processes.coordinator(*small)
    worker = processes.worker("--task", tasks.SLOW_TOY)
    worker.wait_for_event("joined")
    own = psutil.Process(worker.popen.pid)
    for each in (own, *own.children()):
        each.terminate()
    assert worker.finish(120)[0] == 0
    assert not [line for line in worker.lines if line.facts.get("level") == "warning"]
