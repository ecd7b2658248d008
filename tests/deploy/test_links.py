"""A clone whose symbolic links git wrote as files is neither built nor imported."""

import shutil
import subprocess
import sys

import pytest

from tests.support.processes import ROOT


@pytest.mark.parametrize("words", [["setup.py", "--name"], ["-c", "import dreamfleet"]])
def test_a_clone_without_links_stops_and_names_the_setting(words, tmp_path):
    def run():
        return subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=False)

    link = tmp_path / "dreamfleet" / "common"
    link.parent.mkdir()
    link.write_text("../common")
    for name in ("setup.py", "dreamfleet/__init__.py"):
        shutil.copy(ROOT / name, tmp_path / name)
    stopped = run()
    assert stopped.returncode == 1
    assert "core.symlinks" in stopped.stderr.splitlines()[-1]
    link.unlink()
    link.mkdir()
    assert run().returncode == 0
