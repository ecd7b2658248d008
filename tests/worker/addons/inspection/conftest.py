"""The shipped bundle and controller, to inspect, and the verb that inspects."""

import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.worker.addons.inspection import probe
from dreamfleet.worker.addons.inspection import verb as inspect
from tests.support.verbs import run_verb


@pytest.fixture(scope="module")
def tiny():
    return find_bundle("tiny")


@pytest.fixture(scope="module")
def controller(tmp_path_factory):
    return find_controller("tiny", tmp_path_factory.mktemp("runs"))[0]


@pytest.fixture
def call(tmp_path, capsys, monkeypatch):
    """Run `inspect` with short probes; what it prints."""
    monkeypatch.setattr(probe, "UPDATES", 30)

    def run(*arguments):
        assert run_verb(inspect, *arguments, runs_dir=tmp_path) == 0
        return capsys.readouterr().out

    return run
