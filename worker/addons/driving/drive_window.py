"""The window of a person who drives: it shows the picture and the score, and reads the keys."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Literal, Self

import numpy as np
import pygame
from numpy.typing import NDArray

from dreamfleet.common.errors import NoDisplayError
from dreamfleet.worker.addons.recording.canvas import BACKGROUND, FAINT, INK

FRAMES_PER_SECOND = 50  # CarRacing's
BAR_HEIGHT, MIN_WIDTH = 64, 640  # pixels that the text needs
INVISIBLE = ("offscreen", "dummy")  # SDL's drivers without a screen
QUIT_KEYS = (pygame.K_ESCAPE, pygame.K_q)
LEFT, RIGHT = (pygame.K_LEFT, pygame.K_a), (pygame.K_RIGHT, pygame.K_d)
GAS, BRAKE = (pygame.K_UP, pygame.K_w), (pygame.K_DOWN, pygame.K_s)
BRAKE_STRENGTH = 0.8  # as gymnasium's own keyboard control: at 1 the wheels lock
WindowCommand = Literal["again", "quit"]


class Pedals:
    """Steering, gas and brake by the arrow keys or WASD."""

    def __init__(self) -> None:
        self._held: set[int] = set()

    def handle_event(self, event: pygame.event.Event) -> None:
        """Note keys that go down or up. When the window loses focus all keys count as up: later events are not seen."""
        if event.type == pygame.KEYDOWN:
            self._held.add(event.key)
        elif event.type == pygame.KEYUP:
            self._held.discard(event.key)
        elif event.type == pygame.WINDOWFOCUSLOST:
            self._held.clear()

    def action(self) -> NDArray[np.float32]:
        """The action `(3,)`: steering in [-1, 1], gas and brake in [0, 1]. Left and right together steer straight."""
        left, right, gas, brake = (not self._held.isdisjoint(keys) for keys in (LEFT, RIGHT, GAS, BRAKE))
        return np.array([int(right) - int(left), gas, BRAKE_STRENGTH * brake], dtype=np.float32)


class DriveWindow:
    """Shows pictures of one size, at most 50 a second; use it in a `with`."""

    def __init__(self, name: str, picture: tuple[int, int], scale: float) -> None:
        """`picture` is the width and height before `scale`; `NoDisplayError` if no window can be opened."""
        self._size = max(1, round(picture[0] * scale)), max(1, round(picture[1] * scale))
        width = max(self._size[0], MIN_WIDTH)
        self._left = (width - self._size[0]) // 2
        self._name = name
        size = width, self._size[1] + BAR_HEIGHT
        self._screen = open_display(size, "drive where there is one, or through `ssh -X`")
        pygame.font.init()
        self._large, self._small = pygame.font.Font(None, 30), pygame.font.Font(None, 22)
        self._clock = pygame.time.Clock()
        self._caption = ""
        self.pedals = Pedals()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        pygame.display.quit()

    def read_commands(self) -> Iterator[WindowCommand]:
        """The commands since the last call; all key events also go to `pedals`."""
        for event in pygame.event.get():
            self.pedals.handle_event(event)
            if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key in QUIT_KEYS):
                yield "quit"
            elif event.type == pygame.KEYDOWN and event.key == pygame.K_r:
                yield "again"

    def show(self, picture: pygame.Surface, score: float, step: int, steps: int, *, over: bool) -> None:
        """Draw the picture above these numbers, and wait until the next frame is due."""
        self._screen.fill(BACKGROUND)
        fitting = picture if picture.get_size() == self._size else pygame.transform.scale(picture, self._size)
        self._screen.blit(fitting, (self._left, 0))
        top, rate = self._size[1], self._clock.get_fps()
        pace = "over" if over else f"{rate:.0f} frames/s, {rate / FRAMES_PER_SECOND:.1f} x time"
        self._text(f"score {score:z.1f}   step {step} of {steps}   {pace}", top + 10, self._large, INK)
        self._text("arrows or WASD: drive    R: again    Esc or Q: quit", top + 38, self._small, FAINT)
        caption = f"dreamfleet: {self._name}{', over' if over else ''}"
        if caption != self._caption:
            pygame.display.set_caption(caption)
            self._caption = caption
        pygame.display.flip()
        self._clock.tick(FRAMES_PER_SECOND)

    def _text(self, text: str, top: int, font: pygame.font.Font, colour: tuple[int, int, int]) -> None:
        self._screen.blit(font.render(text, True, colour), (12, top))


def open_display(size: tuple[int, int], remedy: str) -> pygame.Surface:
    """Open a window and return its surface; an invisible one only if `$SDL_VIDEODRIVER` requests it.

    `NoDisplayError` with the `remedy` if no window can be opened.
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
    """Make SDL use a visible display without OpenGL, unless environment variables say otherwise.

    By default SDL may fall back to an invisible driver and draws through OpenGL. Both load Mesa's LLVM into the
    process, on which torch's triton crashes when it is loaded later.
    """
    wanted = {"SDL_FRAMEBUFFER_ACCELERATION": "0"}
    if sys.platform == "linux":
        # Wayland's library prints a line of its own where its socket's folder has no name.
        wanted["SDL_VIDEODRIVER"] = "wayland,x11" if os.environ.get("XDG_RUNTIME_DIR") else "x11"
    added = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]
