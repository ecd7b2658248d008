"""The tutorial's own code and commands make a world model of its world, from an empty folder, on a small share."""

import pytest

from tests.docs.tutorial import WHOLE, run_tutorial

SHARES = {
    "--scale 0.5": "--scale 0.005 --jobs 1 --yes",
    "--episodes 1000": "--episodes 8",
    "--updates 1500": "--updates 8",
    "--survival": "--survival --episodes 4",
    "--generations 60": "--generations 2 --population 4 --episodes 2 --evaluate-every 1 --confirm-episodes 2",
    "--episodes 100": "--episodes 2",
}


@pytest.mark.slow
@pytest.mark.timeout(WHOLE + 60)
def test_its_commands_work_as_they_stand(tmp_path):
    printed = run_tutorial("own-world-model.md", "my_world.py", SHARES, tmp_path)
    for made in ("data/pixels.zip", "inspection/index.html", "runs/canyon/controller.npz", "drive.mp4"):
        assert (tmp_path / made).exists()
    assert "gym:my_world:Canyon-v0" in printed
