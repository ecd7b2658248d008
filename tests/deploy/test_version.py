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


@pytest.mark.slow
def test_versions_grow_with_the_commits_and_differ_where_the_code_does(tmp_path):
    text = (ROOT / "pyproject.toml").read_text()
    project = tomllib.loads(text)
    assert "version" in project["project"]["dynamic"]
    assert any(each.startswith("setuptools-scm") for each in project["build-system"]["requires"])
    section = text[text.index(SECTION) :].partition("\n\n")[0]
    checkout = tmp_path / "checkout"
    checkout.mkdir()
    (checkout / "pyproject.toml").write_text(f'[project]\nname = "dreamfleet"\ndynamic = ["version"]\n{section}\n')
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
