"""The verb `drive` in a window on a virtual screen, with keys of a virtual keyboard.
Tests verb.py."""

import os
import re
import subprocess
import sys

import pytest

from dreamfleet.worker.worlds.car_racing.native_check import make_car_racing
from tests.support.processes import DEADLINE, environment, started

SEED, STEPS = 20_003, 60
pytestmark = pytest.mark.needs_programs("Xvfb", "xdotool")


@pytest.fixture
def screen():
    """The number of a virtual X screen."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1280x1024x24", "-nolisten", "tcp"]
    with started(command, pass_fds=[write], stderr=subprocess.DEVNULL):
        os.close(write)
        with os.fdopen(read) as pipe:
            number = pipe.readline().strip()
        yield f":{number}"


def standing_still():
    environment = make_car_racing(preprocessing="box-64")
    environment.reset(seed=SEED)
    score = sum(float(environment.step([0.0, 0.0, 0.0])[1]) for _ in range(STEPS))
    environment.close()
    return score


@pytest.mark.slow
def test_a_person_drives_and_quits(screen, tmp_path):
    seen = {**environment(tmp_path), "DISPLAY": screen, "SDL_VIDEODRIVER": "x11"}

    def hand(*arguments):
        subprocess.run(["xdotool", *arguments], env=seen, check=True, timeout=DEADLINE, stdout=subprocess.DEVNULL)

    command = [sys.executable, "-m", "dreamfleet", "drive", "--seed", str(SEED), "--steps", str(STEPS)]
    with started([*command, "--scale", "0.3"], env=seen, stdout=subprocess.PIPE, text=True) as driving:
        hand("search", "--sync", "--onlyvisible", "--class", ".", "windowfocus", "--sync", "keydown", "Up")
        said = driving.stdout.readline()  # printed at the episode's end
        hand("keyup", "Up", "key", "q")
        assert driving.wait(DEADLINE) == 0
    score, steps = re.search(rf"(-?[\d.]+)\D* (\d+)\D* {SEED}", said).groups()
    assert int(steps) == STEPS
    assert float(score) > standing_still() + 5, "the car did not move"
