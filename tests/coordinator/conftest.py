"""What several tests of the coordinator begin from."""

import shutil
from pathlib import Path

import pytest

FIXTURES = Path(__file__).parents[1] / "fixtures"


@pytest.fixture
def runs(tmp_path):
    """Recorded runs, each with its world model."""
    for name in ("dream", "reality", "hidden"):
        shutil.copytree(FIXTURES / "runs" / name, tmp_path / "runs" / name)
        shutil.copyfile(FIXTURES / "small.zip", tmp_path / "runs" / name / "bundle.zip")
    return tmp_path / "runs"
