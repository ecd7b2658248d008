"""The tutorial's own environment and commands lead from an empty folder to a compared controller, on a small scale."""

import re

import pytest

from tests.docs.tutorial import WHOLE, run_tutorial

SHARES = {
    "--generations 30 --evaluate-every 10": "--generations 2 --population 4 --evaluate-every 1 --evaluation-episodes 2"
    " --confirm-episodes 2",
    "--episodes 100": "--episodes 2",
}


@pytest.mark.slow
@pytest.mark.timeout(WHOLE + 60)
def test_its_commands_work_as_they_stand(tmp_path):
    printed = run_tutorial("own-environment.md", "my_drone.py", SHARES, tmp_path)
    for made in ("runs/drone/controller.npz", "runs/hidden/controller.npz", "drone-fitness.png", "drive.mp4"):
        assert (tmp_path / made).exists()
    assert "6 observations, 2 outputs" in printed
    assert "gym:my_drone:Drone-v0" in printed
    assert re.search(r"hidden\.json .*linear\.json", printed)
