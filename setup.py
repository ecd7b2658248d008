"""Stops the build of a clone without symbolic links, whose wheel would be hollow; pyproject.toml says all else."""

from pathlib import Path

from setuptools import setup

if (Path(__file__).parent / "dreamfleet" / "common").is_file():
    raise SystemExit(
        "dreamfleet/common is a file: git made no symbolic links. Make them (on Windows in WSL), then install again: "
        "git config core.symlinks true && git checkout -- dreamfleet"
    )
setup()
