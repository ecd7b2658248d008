"""The verb `drive` on a virtual screen; no display is opened without need, and none harms a training that follows.
Tests verb.py."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec

import pytest

from dreamfleet.worker.worlds.car_racing.native_check import make_car_racing
from tests.support.processes import DEADLINE, ROOT, environment, started

SEED, STEPS = 20_003, 60


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
@pytest.mark.needs_programs("Xvfb", "xdotool")
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


WITHOUT_A_SCREEN = """
from dreamfleet.common.errors import NoDisplayError
from dreamfleet.worker.addons.driving.drive_window import DriveWindow
try:
    DriveWindow("nothing", (64, 64), 1)
except NoDisplayError:
    pass
"""
DRIVING_UNSEEN = """
from dreamfleet.common.runs.lookup import find_bundle_of
from dreamfleet.worker.worlds.car_racing.native_check import make_car_racing
environment = make_car_racing(preprocessing="box-64", render_mode="rgb_array")
environment.reset(seed=1)
environment.step([0.0, 0.0, 0.0])
environment.render()
"""
WHAT_IS_LOADED = """
maps = open("/proc/self/maps").read()
print([name for name in ("libLLVM", "libEGL", "libGLX") if name in maps])
"""
OPENED_WHERE_NOBODY_SEES = """
import pygame
pygame.display.init()  # as SDL does by itself without a screen, through Mesa
pygame.display.set_mode((100, 100))
"""
AN_OPTIMISER = """
from pathlib import Path
import torch
from dreamfleet.worker.training.training_state import TrainingState
from dreamfleet.worker.training.presets import TrainConfig
TrainingState(Path("nothing.safetensors"), torch.nn.Linear(2, 2), TrainConfig(updates=1, batch=1, rate=1e-3), 1)
print("goes on")
"""


def run(code, folder, *, silent=True, **variables):
    without = ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY", "XDG_RUNTIME_DIR")
    environment = {name: value for name, value in os.environ.items() if name not in without}
    environment |= {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]), **variables}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=folder, capture_output=True, text=True, timeout=DEADLINE,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert not silent or "XDG_RUNTIME_DIR" not in done.stderr, "Wayland's library has nothing to say where it is not"
    return done.stdout.splitlines()[-1]


def test_looking_for_a_screen_loads_no_graphics_driver(tmp_path):
    assert run(WITHOUT_A_SCREEN + WHAT_IS_LOADED, tmp_path) == "[]"


def test_driving_opens_no_display(tmp_path):
    assert run(DRIVING_UNSEEN + WHAT_IS_LOADED, tmp_path) == "[]"


@pytest.mark.slow
def test_a_process_that_drew_through_mesa_trains(tmp_path):
    """The real triton if torch installed it, or else a fake that crashes the process as the real one does."""
    if find_spec("triton") is None:
        (tmp_path / "triton").mkdir()
        stand_in = "import os\nif 'libLLVM' in open('/proc/self/maps').read(): os._exit(139)\n"
        (tmp_path / "triton" / "__init__.py").write_text(stand_in)
    assert run(OPENED_WHERE_NOBODY_SEES + AN_OPTIMISER, tmp_path, silent=False) == "goes on"
