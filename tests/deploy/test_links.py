"""A clone whose symbolic links git wrote as files is neither built nor imported."""

import shutil
import subprocess
import sys

import pytest

from tests.support.processes import ROOT


@pytest.fixture
def clone(tmp_path):
    (tmp_path / "dreamfleet").mkdir()
    for name in ("setup.py", "dreamfleet/__init__.py"):
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "dreamfleet" / "common").write_text("../common")
    return tmp_path


@pytest.mark.parametrize("words", [["setup.py", "--name"], ["-c", "import dreamfleet"]])
def test_a_clone_without_links_stops_and_names_the_setting(words, clone):
    def run():
        return subprocess.run([sys.executable, *words], cwd=clone, capture_output=True, text=True, check=False)

    stopped = run()
    assert stopped.returncode == 1
    assert "core.symlinks" in stopped.stderr.splitlines()[-1]
    (clone / "dreamfleet" / "common").unlink()
    (clone / "dreamfleet" / "common").mkdir()
    assert run().returncode == 0
