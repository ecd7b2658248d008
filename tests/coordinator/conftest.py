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


@pytest.fixture
def make_bench(tmp_path, random_bundle):
    """Makes benches of a kind, each in a folder of its own; their journals are closed with the test."""
    made = []

    def make(kind, *given, **options):
        made.append(kind(tmp_path / "runs" / f"night-{len(made)}", random_bundle.path, *given, **options))
        return made[-1]

    yield make
    for each in made:
        each.journal.close()
