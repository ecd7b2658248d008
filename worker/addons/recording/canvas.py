"""Drawing one step of a drive as one frame: the world, and beside it what the model sees, decodes and dreams."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.worlds.profile import WorldProfile
from dreamfleet.worker.scoring.disturbance import numbered_choices
from dreamfleet.worker.tasks.api import Actions, Continuous, Discrete

try:
    import pygame
except ModuleNotFoundError:  # then videos have pictures without words
    pygame = None  # type: ignore[assignment]

log = logging.getLogger(__name__)
SIDE = 192  # pixels of the small pictures: three times or twice their size
MARGIN, LABEL, GAP = 8, 22, 10
BACKGROUND, INK, FAINT = (18, 20, 24), (235, 235, 235), (150, 155, 165)
COLOURS = ((120, 170, 255), (110, 210, 120), (240, 110, 100))
MAX_BARS, BAR, MIN_WIDTH = 3, 122, 600  # bars of actions; pixels of a bar, and of a world's picture
FEWEST_SMOOTHED = 64  # pixels of the shorter side; fewer are drawn as squares

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


DREAMING = FrameLayout((900, 600))  # with three small pictures


def plain_layout(picture: Frame) -> FrameLayout:
    """The layout of a world's picture alone, wide enough for the text below it."""
    height, width = picture.shape[:2]
    scale = max(1.0, MIN_WIDTH / width)
    return FrameLayout((round(width * scale) // 2 * 2, round(height * scale) // 2 * 2), column=False)


@dataclass(frozen=True)
class ModelPictures:
    """The picture that a world model sees, the decoded latent, and the picture that it dreams `since` a step."""

    seen: Frame
    decoded: Frame
    dreamt: Frame
    since: int


@dataclass(frozen=True)
class DriveFrame:
    """What is drawn of one step."""

    track: Frame
    action: NDArray[Any]
    step: int
    score: float
    pictures: ModelPictures | None = None
    end: str = ""  # how the drive ended, after its last step


class Board:
    """A surface with methods that draw pictures, text and bars of actions."""

    def __init__(self, size: tuple[int, int], names: tuple[str, ...] = (), actions: Actions | None = None) -> None:
        """`names` are those of the actions, and `actions` gives the ends of their bars; by default -1 and 1."""
        if pygame is None:
            raise ModuleNotFoundError(name="pygame")
        pygame.font.init()
        self._names, self._actions = names, actions
        self._large = pygame.font.Font(None, 30)
        self._small = pygame.font.Font(None, 22)
        self._surface = pygame.Surface(size)

    def _draw_action(self, action: NDArray[Any], right: int, top: int) -> None:
        """Draw bars of a continuous action, left of `right`; of one of several choices its name."""
        if (choice := choice_name(action, self._names, self._actions)) is not None:
            label = "action "
            left = right - 16 - max(BAR, self._small.size(label + choice)[0])
            self._text(label, (left, top), self._small, FAINT)
            self._text(choice, (left + self._small.size(label)[0], top), self._small, INK)
            return
        shown = action[:MAX_BARS]
        names = self._names or tuple(f"action {index}" for index in range(len(shown)))
        for index, (name, value) in enumerate(zip(names, shown, strict=False)):
            low, high = -1.0, 1.0
            if isinstance(self._actions, Continuous):
                low, high = self._actions.low[index], self._actions.high[index]
            self._bar(name, COLOURS[index], (float(value), low, high), (right - (len(shown) - index) * BAR, top))

    def _fitted(self, picture: Frame, corner: Corner, room: tuple[int, int]) -> None:
        """Draw a picture as large as `room` allows, in its middle; pixels stay visible where they are few."""
        size = size_within(room, picture)
        place = corner[0] + (room[0] - size[0]) // 2, corner[1] + (room[1] - size[1]) // 2
        self._picture(picture, place, size, smooth=min(picture.shape[:2]) >= FEWEST_SMOOTHED)

    def _picture(self, picture: Frame, corner: Corner, size: tuple[int, int], *, smooth: bool = False) -> None:
        """Draw a picture at `size`: smoothed, or with visible pixels."""
        surface = pygame.surfarray.make_surface(np.transpose(picture, (1, 0, 2)))
        scale = pygame.transform.smoothscale if smooth else pygame.transform.scale
        self._surface.blit(scale(surface, size), corner)

    def _text(self, text: str, corner: Corner, font: pygame.font.Font, colour: tuple[int, int, int]) -> None:
        self._surface.blit(font.render(text, True, colour), corner)

    def _draw_score(self, label: str, amount: str, corner: Corner) -> None:
        """Draw a score's number after what it counts, so that the words stand still."""
        self._text(f"{label} ", corner, self._large, FAINT)
        self._text(amount, (corner[0] + self._large.size(f"{label} ")[0], corner[1]), self._large, INK)

    def _bar(
        self, name: str, colour: tuple[int, int, int], value_between: tuple[float, float, float], corner: Corner
    ) -> None:
        """Draw a value between its least and most: from the left end if it is never below 0, else from the middle."""
        left, top = corner
        value, low, high = value_between
        from_left = low >= 0
        self._text(f"{name} {value:z.2f}" if from_left else f"{name} {value:+z.2f}", corner, self._small, FAINT)
        box = pygame.Rect(left, top + 22, 106, 14)
        pygame.draw.rect(self._surface, (45, 48, 56), box)
        start = box.left if from_left else box.centerx
        share = (value - low) / max(high - low, 1e-9) if from_left else value / max(-low, high, 1e-9)
        length = round(float(np.clip(share, 0 if from_left else -1, 1)) * (box.width if from_left else box.width / 2))
        pygame.draw.rect(self._surface, colour, (min(start, start + length), box.top, abs(length), box.height))


class Canvas(Board):
    """Draws frames of a recorded drive."""

    def __init__(
        self, seed: int, profile: WorldProfile, layout: FrameLayout = DREAMING, names: tuple[str, ...] = (),
        actions: Actions | None = None,
    ) -> None:  # fmt: skip
        super().__init__(layout.size, names, actions)
        self._seed, self._profile, self._layout = seed, profile, layout

    def draw(self, moment: DriveFrame) -> Frame:
        """The frame `(height, width, 3)`."""
        width, height = self._layout.track
        self._surface.fill(BACKGROUND)
        self._fitted(moment.track, (MARGIN, MARGIN), self._layout.track)
        if moment.pictures is not None:
            self._draw_model(moment.pictures)
        if moment.end:
            self._draw_end(moment.end)
        profile = self._profile
        self._draw_score(profile.score_label, profile.format_amount(moment.score), (12, height + 24))
        self._text(f"step {moment.step}   {profile.score_word} {self._seed}", (12, height + 52), self._small, FAINT)
        self._draw_action(moment.action, width + 16, height + 26)
        return pixels(self._surface)

    def _draw_end(self, text: str) -> None:
        """Draw a text on a band across the top of the world's picture: games show their own figures below."""
        width, _ = self._layout.track
        drawn = self._large.render(text, True, INK)
        band = pygame.Surface((width, drawn.get_height() + 2 * GAP), pygame.SRCALPHA)
        band.fill((*BACKGROUND, 200))
        band.blit(drawn, ((width - drawn.get_width()) // 2, GAP))
        self._surface.blit(band, (MARGIN, MARGIN))

    def _draw_model(self, pictures: ModelPictures) -> None:
        column = (
            ("what the model sees", pictures.seen),
            ("what it decodes", pictures.decoded),
            (f"dreaming since step {pictures.since}", pictures.dreamt),
        )
        for row, (label, picture) in enumerate(column):
            left, top = self._layout.track[0] + 20, MARGIN + row * (LABEL + SIDE + GAP)
            self._text(label, (left, top), self._small, FAINT)
            self._picture(picture, (left, top + LABEL), (SIDE, SIDE))


class PlainCanvas:
    """Draws frames where pygame is missing: the pictures of `Canvas`, in their places, with pixels that one sees."""

    def __init__(self, layout: FrameLayout) -> None:
        log.warning("pygame is missing: the video shows pictures without words (pip install 'dreamfleet[worker]')")
        self._layout = layout

    def draw(self, moment: DriveFrame) -> Frame:
        """The frame `(height, width, 3)`."""
        width, height = self._layout.size
        frame = np.full((height, width, 3), BACKGROUND, np.uint8)
        _paste(frame, moment.track, MARGIN, MARGIN, size_within(self._layout.track, moment.track))
        pictures = moment.pictures
        for row, picture in enumerate((pictures.seen, pictures.decoded, pictures.dreamt) if pictures else ()):
            top = MARGIN + row * (LABEL + SIDE + GAP) + LABEL
            _paste(frame, picture, self._layout.track[0] + 20, top, (SIDE, SIDE))
        return frame


def make_canvas(
    seed: int, profile: WorldProfile, layout: FrameLayout, names: tuple[str, ...], actions: Actions | None
) -> Canvas | PlainCanvas:
    """What draws a drive's frames here."""
    return PlainCanvas(layout) if pygame is None else Canvas(seed, profile, layout, names, actions)


def _paste(frame: Frame, picture: Frame, left: int, top: int, size: tuple[int, int]) -> None:
    width, height = size
    rows, columns = np.arange(height) * picture.shape[0] // height, np.arange(width) * picture.shape[1] // width
    frame[top : top + height, left : left + width] = picture[rows[:, None], columns]


def choice_name(action: NDArray[Any], names: tuple[str, ...], actions: Actions | None) -> str | None:
    """The name of the choice that an action is, else its number of so many; `None` if there are no numbered choices.

    A choice of several parts has the names of all of them.

    >>> from dreamfleet.worker.tasks.api import one_hot
    >>> choice_name(np.array([0, 1, 0], np.float32), ("stay", "left", "right"), one_hot(3))
    'left'
    """
    if action.dtype.kind in "iu":
        number = int(action[0])
        index = number - actions.first if isinstance(actions, Discrete) else number
        if 0 <= index < len(names):
            return names[index]
        if isinstance(actions, Discrete):
            return f"{number} of {actions.first} to {actions.first + actions.outputs - 1}"
        return str(number)
    if not isinstance(actions, Continuous) or not len(choices := numbered_choices(actions)):
        return None
    if len(names) == len(action):
        return " ".join(name for name, value in zip(names, action, strict=True) if value) or "none"
    if actions.groups:
        return " ".join(map(str, actions.to_numbers(action)))
    found = np.flatnonzero((choices == action).all(axis=1))
    return f"{found[0]} of {len(choices)}" if len(found) else "none"


def pixels(surface: pygame.Surface) -> Frame:
    """A surface as an array `(height, width, 3)`; ten times faster than transposing pygame's own array."""
    width, height = surface.get_size()
    return np.frombuffer(pygame.image.tobytes(surface, "RGB"), np.uint8).reshape(height, width, 3)


def size_within(room: tuple[int, int], picture: Frame) -> tuple[int, int]:
    """Width and height of a picture that is drawn as large as `room` allows, in its proportions."""
    height, width = picture.shape[:2]
    scale = min(room[0] / width, room[1] / height)
    return max(1, round(width * scale)), max(1, round(height * scale))
