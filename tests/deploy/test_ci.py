"""What CI does with a test that failed: it runs again by itself, unless it is `exact`."""

import subprocess
import sys
from pathlib import Path

import pytest

from deploy import ci

pytestmark = pytest.mark.slow

MAKEFILE = "test slow:\n\t.venv/bin/pytest -q -p no:xdist $(ARGS)\ncheck:\n\ttrue\nbroken:\n\tfalse\n"
BY_CHANCE = """
import os
from pathlib import Path
import pytest

def fails_once(name):
    failed = Path(name).exists()
    Path(name).touch()
    assert failed

@pytest.mark.parametrize("value", range({chance}))
def test_by_chance(value):
    fails_once(f"chance-{{value}}")

@pytest.mark.parametrize("value", range({wrong}))
def test_wrong(value):
    assert False

@pytest.mark.exact
@pytest.mark.parametrize("value", range({exact}))
def test_bits(value):
    fails_once(f"exact-{{value}}")
"""


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project of few tests, of which so many fail by chance, always, and by chance although they are exact."""

    def make(chance=0, wrong=0, exact=0):
        (tmp_path / "Makefile").write_text(MAKEFILE)
        (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n    exact: never again\n")
        (tmp_path / "test_it.py").write_text(BY_CHANCE.format(chance=chance, wrong=wrong, exact=exact))
        (tmp_path / ".venv").mkdir()
        (tmp_path / ".venv/bin").symlink_to(Path(sys.executable).parent)
        monkeypatch.chdir(tmp_path)

    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    return make


def run(*names):
    """Each part's failed and unstable tests, by a process of its own."""
    parts = [ci.Part(name) for name in names]
    for part in parts:
        part.run(ci.MAX_UNSTABLE - sum(len(each.unstable) for each in parts))
    return [(part.failed, part.unstable) for part in parts]


def test_what_failed_by_chance_is_unstable_and_what_failed_twice_or_runs_only_once_fails_the_run(project):
    project(chance=1, wrong=1, exact=1)
    assert run("test") == [
        (["test_it.py::test_bits[0]", "test_it.py::test_wrong[0]"], ["test_it.py::test_by_chance[0]"])
    ]


def test_of_more_than_three_none_runs_again(project):
    project(chance=4)
    [(failed, unstable)] = run("test")
    assert len(failed) == 4
    assert not unstable


def test_a_module_that_cannot_be_imported_and_a_part_that_is_no_test_fail_by_their_names(project):
    project()
    Path("test_broken.py").write_text("import no_such_module\n")
    assert run("check", "broken", "test") == [([], []), (["make broken"], []), (["test_broken.py"], [])]


@pytest.mark.parametrize(("wrong", "code"), [(0, 0), (1, 1)])
def test_the_last_lines_name_parts_and_unstable_tests(project, wrong, code):
    project(chance=1, wrong=wrong)
    script = str(Path(ci.__file__))
    ended = subprocess.run([sys.executable, script, "check", "test"], capture_output=True, text=True, check=False)
    lines = ended.stdout.splitlines()
    assert ended.returncode == code, ended.stdout
    assert "test_it.py::test_by_chance[0] (test)" in lines[-1]
    assert any("check" in line and "all" in line for line in lines)
