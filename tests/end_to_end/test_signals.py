"""Verbs that start others end on Ctrl-C and SIGTERM, also where they were started to ignore it, and leave nobody."""

import signal
import time
from pathlib import Path

import pytest

from tests.support.processes import until

IGNORING = ("sh", "-c", 'trap "" INT; exec "$@"', "sh")  # as a shell starts the background jobs of a script
pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")


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
    found, variable = set(), f"DREAMFLEET_CACHE={cache}".encode()
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            if variable in path.read_bytes().split(b"\0"):
                found.add(int(path.parent.name))
        except OSError:  # it has just ended
            continue
    return found


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
