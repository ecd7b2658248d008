"""The version of a build: from the commits, another one for other code, and one without a repository too."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.version import Version

ROOT = Path(__file__).parents[2]
SECTION = "\n[tool.setuptools_scm]\n"


def git(folder, *words):
    who = ("-c", "user.name=n", "-c", "user.email=n@localhost", "-c", "init.defaultBranch=main")
    subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True)


def commit(folder, text):
    (folder / "file").write_text(text)
    git(folder, "add", ".")
    git(folder, "commit", "-m", text)


def version_of(folder):
    command = [sys.executable, "-m", "setuptools_scm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return Version(done.stdout.strip())


@pytest.fixture
def checkout(tmp_path):
    """A folder with this project's settings of its version, and no repository."""
    text = (ROOT / "pyproject.toml").read_text()
    section = text[text.index(SECTION) :].partition("\n\n")[0]
    folder = tmp_path / "checkout"
    folder.mkdir()
    (folder / "pyproject.toml").write_text(f'[project]\nname = "dreamfleet"\ndynamic = ["version"]\n{section}\n')
    return folder


def test_the_project_leaves_its_version_to_the_commits():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    assert any(each.startswith("setuptools-scm") for each in project["build-system"]["requires"])


@pytest.mark.slow
def test_versions_grow_with_the_commits_and_differ_where_the_code_does(checkout, tmp_path):
    without = version_of(checkout)
    git(checkout, "init")
    commit(checkout, "one")
    first = version_of(checkout)
    commit(checkout, "two")
    second = version_of(checkout)
    assert without < first < second < Version("0.1.0")
    assert second.local.startswith("g")
    (checkout / "file").write_text("changed")
    changed = version_of(checkout)
    assert changed.public == second.public or changed > second
    assert changed not in (first, second)
    assert changed == version_of(checkout)  # pip asks twice for one build, and refuses a wheel of another version
    git(checkout, "checkout", "file")
    git(tmp_path, "clone", "--depth", "1", f"file://{checkout}", "shallow")
    shallow = version_of(tmp_path / "shallow")
    assert shallow.local == second.local
    assert shallow != first
    git(checkout, "tag", "v0.1.0")
    assert version_of(checkout) == Version("0.1.0")
    commit(checkout, "three")
    assert Version("0.1.0") < version_of(checkout) < Version("0.1.1")
