import os
import re
import shutil
import signal
import tempfile
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from hypothesis import settings

from tests.support.bundles import write_random_bundle
from tests.support.doom import require_doom
from tests.support.journals import RUNS
from tests.support.processes import processes_in
from tests.support.programs import LIST, NOT_INSTALLED, require_programs

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # gymnasium's checker opens every kind of window that there is


if (
    signal.getsignal(signal.SIGINT) is signal.SIG_IGN
):  # as in a script's background job: all that is started inherits it
    signal.signal(signal.SIGINT, signal.default_int_handler)


settings.register_profile("dreamfleet", deadline=None)  # no test is timed: a busy machine is no counterexample
settings.load_profile("dreamfleet")

ADD_ON_OPTIMISERS = {each.name for each in entry_points(group="dreamfleet.optimisers") if ".addons." in each.value}
EXACT = re.compile(r"(^|_)(bits?|same|equals?|identical|replay\w*|reproduc\w*|determin\w*|exact\w*)(_|$)")


@pytest.hookimpl(tryfirst=True)  # before those that `-m` leaves out are left out
def pytest_collection_modifyitems(items):
    """Mark the tests of equal bits, of the simulation and of chaos, and those that search for a counterexample.

    Those with an optimiser that is an add-on as their parameter need an add-on.
    """
    for item in items:
        values = item.callspec.params.values() if hasattr(item, "callspec") else ()
        if any(isinstance(each, str) and each in ADD_ON_OPTIMISERS for each in values):
            item.add_marker("add_on")
        is_exact = {"simulation", "chaos"} & {*item.path.parts} or EXACT.search(item.name.partition("[")[0])
        if is_exact or getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
            item.add_marker("exact")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    for mark in item.iter_markers("needs_programs"):
        require_programs(*mark.args)
    if item.get_closest_marker("needs_doom"):
        require_doom()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    """pytest's summary has one line for the skips of one place and reason: all for a missing program get one place."""
    report = yield
    if report.skipped and isinstance(report.longrepr, tuple) and NOT_INSTALLED in report.longrepr[2]:
        report.longrepr = (str(LIST), None, report.longrepr[2])
    return report


@pytest.fixture(scope="session", autouse=True)
def no_graphics():
    """No test draws through Mesa in this process: SDL would, without a screen, and torch's triton crashes on that."""
    yield
    maps = Path("/proc/self/maps")
    assert not maps.exists() or "libLLVM" not in maps.read_text()


@pytest.fixture(scope="session", autouse=True)
def trusted_tests():
    """Processes that tests start find the tasks of tests, also those that fixtures of a module start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DREAMFLEET_TRUST", "tests.support")
        yield


@pytest.fixture(scope="session")
def random_bundle(tmp_path_factory):
    return write_random_bundle(tmp_path_factory.mktemp("bundle") / "random.zip")


@pytest.fixture
def runs(tmp_path):
    """Recorded runs, each with its world model."""
    for name in ("dream", "reality", "hidden"):
        shutil.copytree(RUNS / name, tmp_path / "runs" / name)
        shutil.copyfile(RUNS.with_name("small.zip"), tmp_path / "runs" / name / "bundle.zip")
    return tmp_path / "runs"


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder of temporary files, of this process and of those that it starts."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


@pytest.fixture
def processes(tmp_path):
    with processes_in(tmp_path) as running:
        yield running


@pytest.fixture(autouse=True)
def private_folders(tmp_path, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("DREAMFLEET_RUNS_DIR", str(tmp_path / "runs"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("DREAMFLEET_TRUST", "tests.support")  # again: a test may have trusted more
