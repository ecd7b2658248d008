"""Programs of Debian packages that tests need; without one a test is skipped, or fails in CI."""

import os
import shutil
from pathlib import Path

import pytest

LIST = Path(__file__).parents[2] / "deploy" / "test-packages.txt"
SEARCHED = f"{os.environ.get('PATH', os.defpath)}:/usr/local/sbin:/usr/sbin:/sbin"  # sshd is not on a user's PATH
TRUE = ("1", "true")
NOT_INSTALLED = "not installed: "


def packages():
    """The programs of the list, each with its package."""
    lines = [line.split() for line in LIST.read_text().splitlines() if not line.startswith("#")]
    return {program: package for package, program in lines}


def find_program(name):
    """The path of a program, or `None`."""
    return shutil.which(name, path=SEARCHED)


def require_programs(*names):
    """Skip the test unless all of these programs of the list are there; in CI, fail it.

    The reason is the same for all of them.
    """
    listed = packages()
    assert set(names) <= set(listed), f"{LIST} does not name all of {names}"
    if all(find_program(name) for name in names):
        return
    missing = " ".join(package for program, package in listed.items() if not find_program(program))
    reason = f"{NOT_INSTALLED}{missing} (CONTRIBUTING.md has the line that installs them)"
    if os.environ.get("CI", "").lower() in TRUE:
        pytest.fail(f"{reason}; in CI no test is skipped for that", pytrace=False)
    pytest.skip(reason)
