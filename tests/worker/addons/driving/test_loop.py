"""Driving by hand, also on a virtual screen; no display is opened without need.
Tests drive_window.py, loop.py, picture_window.py and verb.py."""

import math
import os
import re
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pygame
import pytest

from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import NoDisplayError, UsageError
from dreamfleet.worker.addons.driving.drive_window import BACKGROUND, DriveWindow, Pedals
from dreamfleet.worker.addons.driving.loop import DreamScene, DrivingConfig, drive, make_scene
from dreamfleet.worker.addons.driving.picture_window import PictureWindow
from dreamfleet.worker.worldmodel.vae_config import PAPER
from dreamfleet.worker.worlds.car_racing.native_check import make_car_racing
from tests.support.bundles import write_random_bundle
from tests.support.processes import DEADLINE, ROOT, environment, started

SEED = 20_003


@pytest.fixture(autouse=True)
def unseen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


def key(kind, code):
    return pygame.event.Event(kind, key=code)


def down(code):
    return key(pygame.KEYDOWN, code)


class Hand:
    """Presses keys after so many frames, as a person would: `{frame: [event]}`."""

    def __init__(self, keys, scene=None):
        self._keys, self._scene = keys, scene
        self.frames, self.steps, self.speeds = 0, [], []

    def __call__(self, step):
        self.frames += 1
        self.steps.append(step)
        if self._scene:
            self.speeds.append(math.hypot(*self._scene.environment.unwrapped.car.hull.linearVelocity))
        for event in self._keys.get(self.frames, ()):
            pygame.event.post(event)


@pytest.mark.parametrize(
    ("held", "action"),
    [
        ((), (0, 0, 0)),
        ((pygame.K_UP,), (0, 1, 0)),
        ((pygame.K_w, pygame.K_a), (-1, 1, 0)),
        ((pygame.K_RIGHT, pygame.K_s), (1, 0, 0.8)),
        ((pygame.K_LEFT, pygame.K_d), (0, 0, 0)),
        ((pygame.K_UP, pygame.K_w, pygame.K_x), (0, 1, 0)),
    ],
)
def test_held_keys_are_an_action_until_they_are_released_or_the_focus_is_lost(held, action):
    released = [key(pygame.KEYUP, code) for code in held]
    for events in (released, [pygame.event.Event(pygame.WINDOWFOCUSLOST)]):
        pedals = Pedals()
        for code in held:
            pedals.handle_event(down(code))
        assert pedals.action() == pytest.approx(action)
        for event in events:
            pedals.handle_event(event)
        assert not pedals.action().any()


def test_holding_up_accelerates_and_q_quits():
    scene = make_scene("car-racing", 1000)
    hand = Hand({1: [down(pygame.K_UP)], 30: [down(pygame.K_q)]}, scene)
    (driven,) = drive(scene, DrivingConfig(SEED, scale=0.2), hand)
    assert (hand.frames, driven.steps) == (30, 30)
    assert hand.speeds[29] > 20 > 1 > hand.speeds[0]


def test_r_restarts_the_same_track(random_bundle):
    scene = DreamScene(random_bundle, 1.0, 3)
    hand = Hand({6: [down(pygame.K_r)], 8: [down(pygame.K_ESCAPE)]})
    whole, left = drive(scene, DrivingConfig(SEED, 3), hand)
    assert (whole.steps, left.steps) == (3, 2)
    assert hand.steps == [1, 2, 3, 3, 3, 3, 1, 2]
    again = Hand({2: [pygame.event.Event(pygame.QUIT)]})
    assert list(drive(DreamScene(random_bundle, 1.0, 3), DrivingConfig(SEED, 3), again)) == [left]


def test_the_dream_is_shown_with_hard_pixels_and_its_score_below():
    with DriveWindow("a dream", (4, 4), 200) as window:
        picture = pygame.Surface((4, 4))
        picture.set_at((1, 0), (255, 0, 0))
        window.show(picture, 1.5, 2, 10, over=True)
        shown = pygame.display.get_surface()
        assert shown.get_size() == (800, 864)
        assert shown.get_at((200, 0))[:3] == shown.get_at((399, 199))[:3] == (255, 0, 0)
        assert shown.get_at((405, 0))[:3] == (0, 0, 0)
        assert pygame.display.get_caption()[0] == "dreamfleet: a dream, over"
        written = pygame.mask.from_threshold(shown.subsurface((0, 800, 800, 64)), (235, 235, 235), (9, 9, 9))
        assert written.count() > 100


@pytest.mark.parametrize("picture", [64, 96])
def test_a_dream_is_driven_at_one_size_whatever_its_model_sees(tmp_path, picture):
    scene = DreamScene(write_random_bundle(tmp_path / "b.zip", vae=replace(PAPER, picture=picture)), 1.0, 5)
    scene.environment.reset(seed=1)
    assert [side * scene.scale for side in scene.surface().get_size()] == [640, 640]


def test_the_longest_text_fits_the_narrowest_window():
    with DriveWindow("a dream", (64, 64), 1) as window:
        for _ in range(12):  # the clock knows its rate after ten frames
            window.show(pygame.Surface((64, 64)), -1234.5, 10_000, 10_000, over=False)
        shown = pygame.display.get_surface()
        right = shown.subsurface((shown.get_width() - 12, 64, 12, 64))
        assert pygame.transform.average_color(right)[:3] == BACKGROUND


PICTURE = np.full((40, 60, 3), (200, 10, 90), np.uint8)


def test_a_picture_window_takes_the_size_of_its_picture_and_keeps_the_last_one():
    with PictureWindow("night") as screen:
        assert screen.draw(None)
        assert screen.draw(PICTURE)
        assert screen.draw(None)
        shown = pygame.display.get_surface()
        assert (shown.get_size(), shown.get_at((30, 20))[:3]) == ((60, 40), (200, 10, 90))
        assert pygame.display.get_caption()[0] == "dreamfleet: night"


@pytest.mark.parametrize("event", [pygame.event.Event(pygame.QUIT), down(pygame.K_q)])
def test_a_viewer_can_close_it(event):
    with PictureWindow("night") as screen:
        assert screen.draw(PICTURE)
        pygame.event.post(event)
        assert not screen.draw(PICTURE)


def test_its_title_takes_a_name_that_is_no_utf_8():
    with PictureWindow("\udcff\udc80"):
        assert pygame.display.get_caption()[0] == "dreamfleet: \\udcff\\udc80"


def test_without_a_screen_a_window_is_an_error(monkeypatch):
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    pygame.display.quit()
    with pytest.raises(NoDisplayError, match=r"--out.*live\.mp4"), PictureWindow("night"):
        pass
    if os.path.exists("/dev/dri"):  # noqa: PTH110
        pytest.skip("a screen may answer without DISPLAY here")
    with pytest.raises(NoDisplayError):
        DriveWindow("nothing", (64, 64), 1)
    assert main(["drive", "--seed", "1"]) == 1


@pytest.mark.parametrize("arguments", [{"seed": -1}, {"seed": 1, "steps": 0}, {"seed": 1, "scale": 0.0}])
def test_invalid_arguments_are_refused(arguments):
    with pytest.raises(UsageError):
        DrivingConfig(**arguments)


def test_a_dreams_temperature_without_a_dream_is_refused(capsys):
    assert main(["drive", "--temperature", "0.5"]) == UsageError.exit_code
    assert "--dream" in capsys.readouterr().err


STEPS = 60


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
