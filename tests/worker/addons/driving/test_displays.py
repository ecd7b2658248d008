"""No display is opened without need, and an opened one does not harm the training that follows."""

import os
import subprocess
import sys
from importlib.util import find_spec

import pytest

from tests.support.processes import DEADLINE, ROOT

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
