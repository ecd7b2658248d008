"""What ships, as it is looked into."""

import pytest

from dreamfleet.common.shelf import find_controller
from dreamfleet.common.store import find_bundle


@pytest.fixture(scope="module")
def tiny():
    return find_bundle("tiny")


@pytest.fixture(scope="module")
def controller(tmp_path_factory):
    return find_controller("tiny", tmp_path_factory.mktemp("runs"))[0]
