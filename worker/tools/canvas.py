"""Drawing one step of a drive as one frame: the track, and beside it what the model sees, decodes and dreams."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pygame
from numpy.typing import NDArray

SIDE = 192  # pixels of the small pictures: three times or twice their size
MARGIN, LABEL, GAP = 8, 22, 10
BACKGROUND, INK, FAINT = (18, 20, 24), (235, 235, 235), (150, 155, 165)
PEDALS = ("gas", "brake")
COLOURS = ((120, 170, 255), (110, 210, 120), (240, 110, 100))
MAX_BARS, BAR, MIN_WIDTH = 3, 122, 600  # bars of actions; pixels of a bar, and of a world's picture

Frame = NDArray[np.uint8]
Corner = tuple[int, int]


@dataclass(frozen=True)
class FrameLayout:
    """The size of the world's picture, and whether there is a column of small pictures beside it."""

    track: tuple[int, int]
    column: bool = True

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a frame; both even, as the codec requires."""
        return self.track[0] + (SIDE + 32 if self.column else 2 * MARGIN), self.track[1] + 80


AWAKE = FrameLayout((600, 400))  # with two small pictures
DREAMING = FrameLayout((900, 600))  # with three


def plain_layout(picture: Frame) -> FrameLayout:
    """The layout of a world's picture alone, wide enough for the text below it."""
    height, width = picture.shape[:2]
    scale = max(1.0, MIN_WIDTH / width)
    return FrameLayout((round(width * scale) // 2 * 2, round(height * scale) // 2 * 2), column=False)


@dataclass(frozen=True)
class DreamPicture:
    """A dreamt picture, and the step of the drive at which the dream started."""

    picture: Frame
    since: int


@dataclass(frozen=True)
class ModelPictures:
    """The picture that a world model sees, the decoded latent, and the dreamt picture."""

    seen: Frame
    decoded: Frame
    dreamt: DreamPicture | None = None


@dataclass(frozen=True)
class DriveFrame:
    """What is drawn of one step."""

    track: Frame
    action: NDArray[Any]
    step: int
    score: float
    pictures: ModelPictures | None = None


class Board:
    """A surface with methods that draw pictures, text and bars of actions."""

    def __init__(self, size: tuple[int, int], actions: tuple[str, ...] = ()) -> None:
        """`actions` are the labels of the bars."""
        pygame.font.init()
        self._actions = actions
        self._large = pygame.font.Font(None, 30)
        self._small = pygame.font.Font(None, 22)
        self._surface = pygame.Surface(size)

    def _draw_action(self, action: NDArray[Any], right: int, top: int) -> None:
        """Draw bars of a continuous action, left of `right`; of a discrete action its number."""
        if action.dtype.kind in "iu":
            self._text(f"action {int(action[0])}", (right - 16 - BAR, top), self._small, FAINT)
            return
        shown = action[:MAX_BARS]
        names = self._actions or tuple(f"action {index}" for index in range(len(shown)))
        for index, (name, value) in enumerate(zip(names, shown, strict=False)):
            self._bar(name, COLOURS[index], float(value), (right - (len(shown) - index) * BAR, top))

    def _picture(self, picture: Frame, corner: Corner, size: tuple[int, int], *, smooth: bool = False) -> None:
        """Draw a picture at `size`: smoothed, or with visible pixels."""
        surface = pygame.surfarray.make_surface(np.transpose(picture, (1, 0, 2)))
        scale = pygame.transform.smoothscale if smooth else pygame.transform.scale
        self._surface.blit(scale(surface, size), corner)

    def _text(self, text: str, corner: Corner, font: pygame.font.Font, colour: tuple[int, int, int]) -> None:
        self._surface.blit(font.render(text, True, colour), corner)

    def _bar(self, name: str, colour: tuple[int, int, int], value: float, corner: Corner) -> None:
        """Draw a bar from its middle, or, for a pedal, from its left end."""
        left, top = corner
        pedal = name in PEDALS
        self._text(f"{name} {value:.2f}" if pedal else f"{name} {value:+.2f}", corner, self._small, FAINT)
        box = pygame.Rect(left, top + 22, 106, 14)
        pygame.draw.rect(self._surface, (45, 48, 56), box)
        start = box.left if pedal else box.centerx
        length = round(float(np.clip(value, -1, 1)) * (box.width if pedal else box.width / 2))
        pygame.draw.rect(self._surface, colour, (min(start, start + length), box.top, abs(length), box.height))


class Canvas(Board):
    """Draws frames of a recorded drive."""

    def __init__(self, seed: int, layout: FrameLayout = AWAKE, actions: tuple[str, ...] = ()) -> None:
        super().__init__(layout.size, actions)
        self._seed = seed
        self._layout = layout

    def draw(self, moment: DriveFrame) -> Frame:
        """The frame `(height, width, 3)`."""
        width, height = self._layout.track
        self._surface.fill(BACKGROUND)
        self._picture(moment.track, (MARGIN, MARGIN), self._layout.track, smooth=True)
        if moment.pictures is not None:
            self._draw_model(moment.pictures)
        self._text(f"score {moment.score:7.1f}", (12, height + 24), self._large, INK)
        self._text(f"step {moment.step}   seed {self._seed}", (12, height + 52), self._small, FAINT)
        self._draw_action(moment.action, width + 16, height + 26)
        return pixels(self._surface)

    def _draw_model(self, pictures: ModelPictures) -> None:
        column = [("what the model sees", pictures.seen), ("what it decodes", pictures.decoded)]
        if pictures.dreamt is not None:
            column.append((f"dreaming since step {pictures.dreamt.since}", pictures.dreamt.picture))
        for row, (label, picture) in enumerate(column):
            left, top = self._layout.track[0] + 20, MARGIN + row * (LABEL + SIDE + GAP)
            self._text(label, (left, top), self._small, FAINT)
            self._picture(picture, (left, top + LABEL), (SIDE, SIDE))


def pixels(surface: pygame.Surface) -> Frame:
    """A surface as an array `(height, width, 3)`; ten times faster than transposing pygame's own array."""
    width, height = surface.get_size()
    return np.frombuffer(pygame.image.tobytes(surface, "RGB"), np.uint8).reshape(height, width, 3)
