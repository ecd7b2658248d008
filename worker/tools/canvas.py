"""One step of a drive as one frame: the track, beside it what the model sees, decodes and dreams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pygame
from numpy.typing import NDArray

SIDE = 192  # of the small pictures: three times or twice their size
MARGIN, LABEL, GAP = 8, 22, 10
BACKGROUND, INK, FAINT = (18, 20, 24), (235, 235, 235), (150, 155, 165)
BARS = (("steer", (120, 170, 255)), ("gas", (110, 210, 120)), ("brake", (240, 110, 100)))

Frame = NDArray[np.uint8]
Corner = tuple[int, int]


@dataclass(frozen=True)
class Layout:
    """How large the track is drawn, so that the small pictures beside it have room."""

    track: tuple[int, int]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a frame."""
        return self.track[0] + SIDE + 32, self.track[1] + 80


AWAKE = Layout((600, 400))  # two small pictures
DREAMING = Layout((900, 600))  # three


@dataclass(frozen=True)
class Dreamt:
    """What the model dreams at a step, and since which step it has not looked."""

    picture: Frame
    since: int


@dataclass(frozen=True)
class Moment:
    """One step of the drive."""

    track: Frame
    seen: Frame
    decoded: Frame
    action: NDArray[np.float32]
    step: int
    score: float
    dreamt: Dreamt | None = None


class Canvas:
    """Lays a moment out as one frame."""

    def __init__(self, seed: int, layout: Layout = AWAKE) -> None:
        pygame.font.init()
        self._seed = seed
        self._layout = layout
        self._large = pygame.font.Font(None, 30)
        self._small = pygame.font.Font(None, 22)
        self._surface = pygame.Surface(layout.size)

    def draw(self, moment: Moment) -> Frame:
        """The frame `(height, width, 3)`."""
        width, height = self._layout.track
        self._surface.fill(BACKGROUND)
        self._picture(moment.track, (MARGIN, MARGIN), self._layout.track, smooth=True)
        column = [("what the model sees", moment.seen), ("what it decodes", moment.decoded)]
        if moment.dreamt is not None:
            column.append((f"dreaming since step {moment.dreamt.since}", moment.dreamt.picture))
        for row, (label, picture) in enumerate(column):
            left, top = width + 20, MARGIN + row * (LABEL + SIDE + GAP)
            self._text(label, (left, top), self._small, FAINT)
            self._picture(picture, (left, top + LABEL), (SIDE, SIDE))
        self._text(f"score {moment.score:7.1f}", (12, height + 24), self._large, INK)
        self._text(f"step {moment.step}   track {self._seed}", (12, height + 52), self._small, FAINT)
        for index, ((name, colour), value) in enumerate(zip(BARS, moment.action, strict=True)):
            self._bar(name, colour, float(value), (width - 350 + index * 122, height + 26))
        return pixels(self._surface)

    def _picture(self, picture: Frame, corner: Corner, size: tuple[int, int], *, smooth: bool = False) -> None:
        """The small pictures keep their pixels' edges; the track is a painting."""
        surface = pygame.surfarray.make_surface(np.transpose(picture, (1, 0, 2)))
        scale = pygame.transform.smoothscale if smooth else pygame.transform.scale
        self._surface.blit(scale(surface, size), corner)

    def _text(self, text: str, corner: Corner, font: pygame.font.Font, colour: tuple[int, int, int]) -> None:
        self._surface.blit(font.render(text, True, colour), corner)

    def _bar(self, name: str, colour: tuple[int, int, int], value: float, corner: Corner) -> None:
        """A bar from its middle for steering, from its left for a pedal."""
        left, top = corner
        self._text(f"{name} {value:+.2f}" if name == "steer" else f"{name} {value:.2f}", corner, self._small, FAINT)
        box = pygame.Rect(left, top + 22, 106, 14)
        pygame.draw.rect(self._surface, (45, 48, 56), box)
        start = box.centerx if name == "steer" else box.left
        length = round(value * (box.width / 2 if name == "steer" else box.width))
        pygame.draw.rect(self._surface, colour, (min(start, start + length), box.top, abs(length), box.height))


def pixels(surface: pygame.Surface) -> Frame:
    """A surface as `(height, width, 3)`; ten times faster than turning pygame's array round."""
    width, height = surface.get_size()
    return np.frombuffer(pygame.image.tobytes(surface, "RGB"), np.uint8).reshape(height, width, 3)
