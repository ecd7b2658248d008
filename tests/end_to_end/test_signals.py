"""Verbs that start others end on Ctrl-C and SIGTERM, also where they were started to ignore it, and leave nobody."""

import shutil
import signal
import time
from pathlib import Path

import pytest

from tests.support.drives import write_encoded_drives

IGNORING = ("sh", "-c", 'trap "" INT; exec "$@"', "sh")  # as a shell starts the background jobs of a script
pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
RUN = "--generations 2 --population 4 --episodes 1 --horizon 10"


@pytest.fixture(scope="module")
def encoded(tmp_path_factory):
    return write_encoded_drives(tmp_path_factory.mktemp("encoded") / "data")


@pytest.fixture
def words(processes, random_bundle, encoded, tmp_path):
    """The command line of a verb that would work for hours."""
    data = tmp_path / "data"
    shutil.copytree(encoded, tmp_path / "encoded")
    drives = ("--data", data, "--jobs", 1)
    return {
        "demo": (
            "demo", "--run", "demo", "--runs-dir", processes.runs, "--port", processes.port, "--bundle",
            random_bundle.path, "--workers", 1, "--no-page", "--dream-minutes", 300,
        ),
        "iterate": ("iterate", *drives, "--drives", 10_000, "--drive-steps", 20, "--local", 1, "--run-flags", RUN),
        "pipeline": ("pipeline", *drives, "--preset", "tiny", "--collect-flags", "--episodes 10000 --steps 20"),
        "contrast": (
            "lab", "contrast", "--data", tmp_path / "encoded", "--out", tmp_path / "out", "--local", 1, "--run-flags",
            RUN, "--mdnrnn-flags", "--updates 1000000 --batch 2 --set latent=4 hidden=4 validate_every=1000000",
        ),
    }  # fmt: skip


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


def wait_for_nobody(cache):
    while of(cache):
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "number"),
    [("demo", signal.SIGINT), ("iterate", signal.SIGTERM), ("pipeline", signal.SIGINT), ("contrast", signal.SIGTERM)],
)
def test_it_ends_however_it_was_started(processes, words, verb, number):
    process = processes.start(*words[verb], inside=IGNORING)
    wait_for_others(process, processes.cache)
    process.popen.send_signal(number)
    assert process.finish()[0] == 130, "".join(process.lines)
    assert "Traceback" not in "".join(process.lines)
    wait_for_nobody(processes.cache)


def test_what_judges_ends_with_an_evaluation_that_is_killed(processes):
    """As by `demo`, which ends while it judges."""
    process = processes.start("evaluate", "--controller", "tiny", "--episodes", 1000, "--jobs", 2)
    wait_for_others(process, processes.cache)
    process.popen.kill()
    wait_for_nobody(processes.cache)
