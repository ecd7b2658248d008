"""A drive as a video: the track, what the model sees of it, and what it makes of that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import gymnasium
import numpy as np
import pygame
from numpy.typing import NDArray

from common.bundle import Bundle
from common.controller import Controller
from common.errors import DatasetError, UsageError
from worker.tasks.car_racing import ENVIRONMENT, CarRacingPolicy, PictureObservation
from worker.worldmodel.inference import Decoder

FRAMES_PER_SECOND = 50  # CarRacing's own
TRACK_SIZE = (600, 400)
SIDE = 192  # the two small pictures, three times their size
WIDTH, HEIGHT = TRACK_SIZE[0] + SIDE + 32, 480
BACKGROUND, INK, FAINT = (18, 20, 24), (235, 235, 235), (150, 155, 165)
BARS = (("steer", (120, 170, 255)), ("gas", (110, 210, 120)), ("brake", (240, 110, 100)))

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class Moment:
    """One step of the drive."""

    track: Frame
    seen: Frame
    decoded: Frame
    action: NDArray[np.float32]
    step: int
    score: float


def record(
    controller: Controller, bundle: Bundle, seed: int, steps: int, out: Path,
    on_step: Callable[[int], None] = lambda _steps: None,
) -> float:  # fmt: skip
    """Drive one episode in gymnasium's own environment into an mp4; returns its score."""
    if controller.task != "car-racing":
        raise UsageError(f"only car-racing can be recorded, not {controller.task}")
    environment = PictureObservation(gymnasium.make(ENVIRONMENT, render_mode="rgb_array"))
    policy, decoder = CarRacingPolicy(bundle), Decoder(bundle)
    policy.begin(controller.parameters)
    observation, _ = environment.reset(seed=seed)
    canvas = Canvas(seed)
    score, step, ended = 0.0, 0, False
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        container = av.open(str(out), "w")
    except OSError as error:
        raise DatasetError(f"cannot write {out}: {error.strerror}; choose another --out") from error
    with container:
        stream = _open_stream(container)
        while step < steps and not ended:
            action = policy.act(observation)
            decoded = decoder.decode(policy.latent)[0]
            track: Any = environment.render()
            frame = canvas.draw(Moment(track, observation, decoded, action, step, score))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
            observation, reward, terminated, truncated, _ = environment.step(action)
            policy.reward(float(reward))
            score, step, ended = score + float(reward), step + 1, terminated or truncated
            on_step(step)
        container.mux(stream.encode())
    environment.close()
    return score


class Canvas:
    """Lays a moment out as one frame."""

    def __init__(self, seed: int) -> None:
        pygame.font.init()
        self._seed = seed
        self._large = pygame.font.Font(None, 30)
        self._small = pygame.font.Font(None, 22)
        self._surface = pygame.Surface((WIDTH, HEIGHT))

    def draw(self, moment: Moment) -> Frame:
        """The frame `(HEIGHT, WIDTH, 3)`."""
        self._surface.fill(BACKGROUND)
        self._picture(moment.track, (8, 8), TRACK_SIZE)
        left = TRACK_SIZE[0] + 20
        for top, label, picture in ((8, "what the model sees", moment.seen), (240, "what it decodes", moment.decoded)):
            self._picture(picture, (left, top + 22), (SIDE, SIDE))
            self._text(label, (left, top), self._small, FAINT)
        self._text(f"score {moment.score:7.1f}", (12, 424), self._large, INK)
        self._text(f"step {moment.step}   track {self._seed}", (12, 452), self._small, FAINT)
        for index, ((name, colour), value) in enumerate(zip(BARS, moment.action, strict=True)):
            self._bar(name, colour, float(value), 250 + index * 122)
        return np.ascontiguousarray(np.transpose(pygame.surfarray.array3d(self._surface), (1, 0, 2)))

    def _picture(self, picture: Frame, corner: tuple[int, int], size: tuple[int, int]) -> None:
        surface = pygame.surfarray.make_surface(np.transpose(picture, (1, 0, 2)))
        self._surface.blit(pygame.transform.scale(surface, size), corner)

    def _text(self, text: str, corner: tuple[int, int], font: pygame.font.Font, colour: tuple[int, int, int]) -> None:
        self._surface.blit(font.render(text, True, colour), corner)

    def _bar(self, name: str, colour: tuple[int, int, int], value: float, left: int) -> None:
        """A bar from its middle for steering, from its left for a pedal."""
        box = pygame.Rect(left, 448, 106, 14)
        pygame.draw.rect(self._surface, (45, 48, 56), box)
        start = box.centerx if name == "steer" else box.left
        length = round(value * (box.width / 2 if name == "steer" else box.width))
        pygame.draw.rect(self._surface, colour, (min(start, start + length), box.top, abs(length), box.height))
        self._text(
            f"{name} {value:+.2f}" if name == "steer" else f"{name} {value:.2f}", (left, 426), self._small, FAINT
        )


def _open_stream(container: Any) -> Any:
    stream = container.add_stream("libx264", rate=FRAMES_PER_SECOND)
    stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    stream.time_base = Fraction(1, FRAMES_PER_SECOND)
    stream.options = {"crf": "23", "preset": "veryfast"}
    return stream
