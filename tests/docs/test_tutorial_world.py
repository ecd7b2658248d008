"""The tutorial's own code and commands make a world model of its world, from an empty folder, on a small share."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import DEADLINE, ROOT, free_port

PAGE = (ROOT / "docs" / "tutorials" / "own-world-model.md").read_text()
SHARES = {
    "--scale 0.5": "--scale 0.005 --jobs 1",
    "--episodes 1000": "--episodes 8",
    "--updates 1500": "--updates 8",
    "--survival": "--survival --episodes 4",
    "--generations 60": "--generations 2 --population 4 --episodes 2 --evaluate-every 1 --confirm-episodes 2",
    "--episodes 100": "--episodes 2",
}


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


@pytest.mark.slow
def test_its_commands_work_as_they_stand(tmp_path):
    (world,), (install, *commands) = blocks("python"), blocks("sh")
    assert "pip install" in install
    script = "".join(commands)
    for whole, share in SHARES.items():
        assert whole in script
        script = script.replace(whole, share)
    (tmp_path / "my_world.py").write_text(world)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    own = {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", "OMP_NUM_THREADS": "1",
        "DREAMFLEET_CACHE": str(tmp_path / "cache"), "DREAMFLEET_LISTEN": endpoint, "DREAMFLEET_CONNECT": endpoint,
    }  # fmt: skip
    done = subprocess.run(
        ("bash", "-ec", script), cwd=tmp_path, env={**os.environ, **own}, capture_output=True, text=True,
        timeout=DEADLINE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for made in ("data/pixels.zip", "inspection/index.html", "runs/canyon/controller.npz", "drive.mp4"):
        assert (tmp_path / made).exists()
    assert "judged in gym:my_world:Canyon-v0" in done.stdout
