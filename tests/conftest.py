import os
from pathlib import Path

import pytest

from tests.support.bundles import write_random_bundle
from tests.support.processes import processes_in

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # gymnasium's checker opens every kind of window that there is


@pytest.fixture(scope="session", autouse=True)
def no_graphics():
    """No test draws through Mesa in this process: SDL would, without a screen, and torch's triton crashes on that."""
    yield
    maps = Path("/proc/self/maps")
    assert not maps.exists() or "libLLVM" not in maps.read_text()


@pytest.fixture(scope="session")
def random_bundle(tmp_path_factory):
    return write_random_bundle(tmp_path_factory.mktemp("bundle") / "random.zip")


@pytest.fixture
def processes(tmp_path):
    with processes_in(tmp_path) as running:
        yield running


@pytest.fixture(autouse=True)
def private_folders(tmp_path, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("DREAMFLEET_RUNS_DIR", str(tmp_path / "runs"))
