"""A window that shows pictures until somebody closes it. Pages: watch.md."""

from __future__ import annotations

import numpy as np
import pygame
from numpy.typing import NDArray

from dreamfleet.common.printable import printable
from dreamfleet.worker.addons.driving.drive_window import QUIT_KEYS, open_display
from dreamfleet.worker.addons.recording.canvas import BACKGROUND, FAINT

INITIAL_SIZE = 720, 680  # pixels, until there is a picture: those of live_view.py
REMEDY = "write a file by --out live.mp4, look where there is a screen, or through `ssh -X`"


class PictureWindow:
    """Use it in a `with`; `NoDisplayError` if no window can be opened."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> PictureWindow:
        self._open(INITIAL_SIZE)
        pygame.font.init()
        self._surface.fill(BACKGROUND)
        text = pygame.font.Font(None, 30).render("waiting for the first picture", True, FAINT)
        self._surface.blit(text, (24, 24))
        pygame.display.flip()
        return self

    def __exit__(self, *_error: object) -> None:
        pygame.display.quit()

    def draw(self, picture: NDArray[np.uint8] | None) -> bool:
        """Show a picture `(height, width, 3)`, or keep the last; return whether the window is still open."""
        for event in pygame.event.get():
            if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key in QUIT_KEYS):
                return False
        if picture is not None:
            size = picture.shape[1], picture.shape[0]
            if size != self._surface.get_size():
                pygame.display.quit()
                self._open(size)
            self._surface.blit(pygame.image.frombuffer(picture.tobytes(), size, "RGB"), (0, 0))
            pygame.display.flip()
        return True

    def _open(self, size: tuple[int, int]) -> None:
        self._surface = open_display(size, REMEDY)
        pygame.display.set_caption(f"dreamfleet: {printable(self._name)}")
