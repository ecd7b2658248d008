"""The window: a picture, how it goes, and what a person wants."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Literal

import pygame

from dreamfleet.common.errors import NoDisplayError
from dreamfleet.worker.driving.pedals import Pedals

FRAMES_PER_SECOND = 50  # CarRacing's
BAR_HEIGHT, MIN_WIDTH = 64, 640  # pixels: what the text needs
BACKGROUND, INK, FAINT = (18, 20, 24), (235, 235, 235), (150, 155, 165)
INVISIBLE = ("offscreen", "dummy")  # what SDL falls back to without a screen
QUIT_KEYS = (pygame.K_ESCAPE, pygame.K_q)
WindowCommand = Literal["again", "quit"]


@dataclass(frozen=True)
class DriveStatus:
    """What stands under the picture."""

    score: float
    step: int
    steps: int
    over: bool


class DriveWindow:
    """Shows pictures of one size, 50 a second at most; use it in a `with`."""

    def __init__(self, name: str, picture: tuple[int, int], scale: float) -> None:
        """`picture` is its width and height before `scale`; `NoDisplayError` where no window can be opened."""
        self._size = max(1, round(picture[0] * scale)), max(1, round(picture[1] * scale))
        width = max(self._size[0], MIN_WIDTH)
        self._left = (width - self._size[0]) // 2
        self._name = name
        self._screen = open_display(
            (width, self._size[1] + BAR_HEIGHT), "drive where there is one, or through `ssh -X`"
        )
        pygame.font.init()
        self._large, self._small = pygame.font.Font(None, 30), pygame.font.Font(None, 22)
        self._clock = pygame.time.Clock()
        self._caption = ""
        self.pedals = Pedals()

    def __enter__(self) -> DriveWindow:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        pygame.display.quit()

    def read_commands(self) -> Iterator[WindowCommand]:
        """What was asked for since the last call; pedals hear of every key."""
        for event in pygame.event.get():
            self.pedals.handle_event(event)
            if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key in QUIT_KEYS):
                yield "quit"
            elif event.type == pygame.KEYDOWN and event.key == pygame.K_r:
                yield "again"

    def show(self, picture: pygame.Surface, status: DriveStatus) -> None:
        """Draw, and wait until the frame's time is over."""
        self._screen.fill(BACKGROUND)
        fitting = picture if picture.get_size() == self._size else pygame.transform.scale(picture, self._size)
        self._screen.blit(fitting, (self._left, 0))
        top, rate = self._size[1], self._clock.get_fps()
        pace = "over" if status.over else f"{rate:.0f} frames/s, {rate / FRAMES_PER_SECOND:.1f} x time"
        self._text(
            f"score {status.score:.1f}   step {status.step} of {status.steps}   {pace}", top + 10, self._large, INK
        )
        self._text("arrows or WASD: drive    R: again    Esc or Q: quit", top + 38, self._small, FAINT)
        caption = f"dreamfleet: {self._name}{', over' if status.over else ''}"
        if caption != self._caption:
            pygame.display.set_caption(caption)
            self._caption = caption
        pygame.display.flip()
        self._clock.tick(FRAMES_PER_SECOND)

    def _text(self, text: str, top: int, font: pygame.font.Font, colour: tuple[int, int, int]) -> None:
        self._screen.blit(font.render(text, True, colour), (12, top))


def open_display(size: tuple[int, int], remedy: str) -> pygame.Surface:
    """The window's surface; one that nobody sees is none, unless `$SDL_VIDEODRIVER` asks for it.

    `NoDisplayError` with the `remedy` where no window can be opened.
    """
    try:
        with _plain_display():
            pygame.display.init()
            driver = pygame.display.get_driver()
            if driver in INVISIBLE and os.environ.get("SDL_VIDEODRIVER") != driver:
                pygame.display.quit()
                raise NoDisplayError(f"no display: no screen answers; {remedy}")
            return pygame.display.set_mode(size)
    except pygame.error as error:
        raise NoDisplayError(f"no display: {error}; {remedy}") from error


@contextmanager
def _plain_display() -> Iterator[None]:
    """Open a display that a person sees and that is drawn without OpenGL, where the environment does not say otherwise.

    Left alone, SDL falls back to a driver that nobody sees, and draws through OpenGL: both load Mesa and its LLVM into
    the process, where torch's triton, loaded later, crashes on it.
    """
    wanted = {"SDL_FRAMEBUFFER_ACCELERATION": "0"}
    if sys.platform == "linux":
        wanted["SDL_VIDEODRIVER"] = "wayland,x11"
    added = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]
