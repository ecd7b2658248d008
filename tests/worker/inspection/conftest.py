"""The shipped bundle and controller, to inspect."""

import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.runs.lookup import find_controller


@pytest.fixture(scope="module")
def tiny():
    return find_bundle("tiny")


@pytest.fixture(scope="module")
def controller(tmp_path_factory):
    return find_controller("tiny", tmp_path_factory.mktemp("runs"))[0]
