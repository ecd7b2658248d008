import numpy as np
import pygame
import pytest

from dreamfleet.common.errors import NoDisplayError
from dreamfleet.worker.addons.driving.picture_window import PictureWindow

PICTURE = np.full((40, 60, 3), (200, 10, 90), np.uint8)


@pytest.fixture
def unseen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


def test_it_takes_the_size_of_its_picture_and_keeps_the_last_one(unseen):
    with PictureWindow("night") as screen:
        assert screen.draw(None)
        assert screen.draw(PICTURE)
        assert screen.draw(None)
        assert pygame.display.get_surface().get_size() == (60, 40)
        assert pygame.display.get_surface().get_at((30, 20))[:3] == (200, 10, 90)
        assert pygame.display.get_caption()[0] == "dreamfleet: night"


@pytest.mark.parametrize("event", [{"type": pygame.QUIT}, {"type": pygame.KEYDOWN, "key": pygame.K_q}])
def test_a_viewer_can_close_it(unseen, event):
    with PictureWindow("night") as screen:
        assert screen.draw(PICTURE)
        pygame.event.post(pygame.event.Event(event.pop("type"), event))
        assert not screen.draw(PICTURE)


def test_without_a_screen_the_error_names_other_ways(monkeypatch):
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(NoDisplayError, match=r"--out.*live\.mp4"), PictureWindow("night"):
        pass


def test_its_title_takes_a_name_that_is_no_utf_8(unseen):
    with PictureWindow("\udcff\udc80"):
        assert pygame.display.get_caption()[0] == "dreamfleet: \\udcff\\udc80"
