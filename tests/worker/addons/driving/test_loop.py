"""Tests loop.py, drive_window.py and picture_window.py."""

import os
from dataclasses import replace

import numpy as np
import pygame
import pytest

from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import NoDisplayError, UsageError
from dreamfleet.worker.addons.driving.drive_window import BACKGROUND, DriveWindow, Pedals
from dreamfleet.worker.addons.driving.loop import DreamScene, DrivingConfig, drive, make_scene
from dreamfleet.worker.addons.driving.picture_window import PictureWindow
from dreamfleet.worker.worldmodel.vae_config import PAPER
from tests.support.bundles import write_random_bundle

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
            self.speeds.append(self._scene.environment.unwrapped.car.hull.linearVelocity.length)
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
