"""Drawing live frames of a worker: what the model sees, what it decodes, and how its dream continues from there."""

from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.addons.frames.live import LiveFrame
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.printable import plural, truncate
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.worlds.score_words import profile_of
from dreamfleet.worker.addons.recording.canvas import BACKGROUND, FAINT, Board, Frame, pixels, size_within
from dreamfleet.worker.addons.recording.parallel_dream import DreamContinuation
from dreamfleet.worker.tasks.api import Actions
from dreamfleet.worker.worldmodel.inference import Decoder

SIZE = 720, 680  # pixels of a frame
MOST_ACTIONS = 1 << 31  # a larger whole number is no choice of one
EDGE, LABEL, BIG, SMALL = 16, 22, 340, 163  # pixels: margin, a line of text, the sides of large and small pictures
STRIP = EDGE + LABEL + BIG + 10  # top of the row of dreamt pictures
FOOT = STRIP + LABEL + SMALL + 16  # top of the text
WHOLE = SIZE[0] - 2 * EDGE, FOOT - EDGE - LABEL - 10  # the space of a picture alone
AHEAD = (10, 25, 50, 100)  # dreamt steps that are shown; a dream leaves reality within some
NAME = 28  # characters of a name that fit
Corner = tuple[int, int]


@dataclass(frozen=True)
class CaptionedFrame:
    """A drawn frame, and the facts that it shows."""

    picture: Frame  # (height, width, 3)
    facts: dict[str, Any]


@dataclass(frozen=True)
class DecodedDream:
    """The decoded latent of a moment, and dreamt pictures of later steps."""

    decoded: Frame
    dreamt: tuple[tuple[int, Frame], ...]  # (steps ahead, picture), as far as the dream lasts


class LiveDreamer:
    """Decodes the latents of live frames and continues them as dreams, with the run's world model."""

    def __init__(self, bundle: Bundle, temperature: float) -> None:
        self._decoder, self._latent = Decoder(bundle), bundle.manifest.latent
        self._continuation = DreamContinuation(bundle, temperature)

    def decode_and_dream(self, live: LiveFrame) -> DecodedDream | None:
        """The decoded dream of a frame; `None` if the frame has no latent of this world model."""
        latent = live.latent
        if latent is None or len(latent) != self._latent:
            return None
        dreamt = self._dream(live)
        pictures = self._decoder.decode(np.stack([latent, *dreamt.values()]))
        return DecodedDream(pictures[0], tuple(zip(dreamt, pictures[1:], strict=True)))

    def _dream(self, live: LiveFrame) -> dict[int, NDArray[np.float32]]:
        """The dreamt latents by steps ahead."""
        if live.latent is None or live.state is None or live.parameters is None:
            return {}
        moment = live.latent, live.state, live.parameters
        if not self._continuation.fits(*moment):
            return {}
        noise = self._continuation.make_noise(live.frame.seed)
        steps = islice(self._continuation.dream(*moment, noise), max(AHEAD))
        return {ahead: latent[0] for ahead, latent in enumerate(steps, 1) if ahead in AHEAD}


class LiveCanvas(Board):
    """Draws live frames of one run, all of the same size."""

    def __init__(
        self, run: str, names: tuple[str, ...] = (), dreamer: LiveDreamer | None = None, actions: Actions | None = None,
        task: str = "",
    ) -> None:  # fmt: skip
        """`names` and `actions` are as in `Board`, `task` the world's; without a `dreamer` only observations show."""
        super().__init__(SIZE, names, actions)
        self._run, self._dreamer, self._profile = run, dreamer, profile_of(task)
        self._captions: list[str] = []  # of the pictures in the frame that is drawn

    def draw(self, live: LiveFrame) -> CaptionedFrame:
        """Draw a frame."""
        dream = None if self._dreamer is None else self._dreamer.decode_and_dream(live)
        self._surface.fill(BACKGROUND)
        self._captions = []
        if dream is not None:
            self._draw_model(live.picture, dream)
        elif live.picture is not None:
            self._draw_fitted("what it looks like", live.picture, (EDGE, EDGE), WHOLE)
        else:
            self._text("this task shows no picture", (EDGE, EDGE), self._small, FAINT)
        self._draw_words(live)
        frame = live.frame
        facts = {
            "run": self._run, "worker": live.worker, "kind": frame.kind, "generation": frame.generation,
            "candidate": frame.candidate, "seed": frame.seed, "step": frame.step, "score": frame.reward,
            "drawn": bool(self._captions), "captions": self._captions,
        }  # fmt: skip
        return CaptionedFrame(pixels(self._surface), facts)

    def _draw_model(self, seen: Frame | None, dream: DecodedDream) -> None:
        """Draw observation and decoded latent side by side; without an observation, the decoded latent alone."""
        left, words = (SIZE[0] - BIG) // 2, "its dream, decoded"
        if seen is not None:
            self._draw_fitted("what the model sees", seen, (EDGE, EDGE), (BIG, BIG))
            left, words = SIZE[0] - EDGE - BIG, "what it decodes"
        self._draw_fitted(words, dream.decoded, (left, EDGE), (BIG, BIG))
        self._draw_strip(dream)

    def _draw_strip(self, dream: DecodedDream) -> None:
        pitch = (SIZE[0] - 2 * EDGE - SMALL) // (len(AHEAD) - 1)
        if not dream.dreamt:
            self._text("no dream continues from here", (EDGE, STRIP), self._small, FAINT)
        for column, (ahead, picture) in enumerate(dream.dreamt):
            words = f"dreamt {plural(ahead, 'step')} on" if column == 0 else f"{plural(ahead, 'step')} on"
            self._draw_fitted(words, picture, (EDGE + column * pitch, STRIP), (SMALL, SMALL))

    def _draw_words(self, live: LiveFrame) -> None:
        frame = live.frame
        whose = f"candidate {frame.candidate}" if frame.kind == "score" else "its mean, in reality"
        lines = [
            f"generation {frame.generation}, {whose}",
            f"run {truncate(self._run, NAME)}   worker {truncate(host_of(live.worker), NAME)}",
            f"step {frame.step}   {self._profile.score_word} {frame.seed}",
        ]
        self._draw_score(self._profile.score_label, self._profile.format_amount(frame.reward), (EDGE, FOOT))
        for row, line in enumerate(lines):
            self._text(line, (EDGE, FOOT + 30 + 20 * row), self._small, FAINT)
        single = frame.action[0] if self._dreamer is None and len(frame.action) == 1 else 0.5
        discrete = single.is_integer() and abs(single) < MOST_ACTIONS
        if frame.action:
            action = np.array(frame.action, np.int64 if discrete else np.float64)
            self._draw_action(action, SIZE[0] - EDGE + 16, FOOT)

    def _draw_fitted(self, label: str, picture: Frame, corner: Corner, room: tuple[int, int]) -> None:
        """Draw a picture as large as `room` allows, below its label."""
        self._captions.append(label)
        self._text(label, corner, self._small, FAINT)
        place, (height, width) = (corner[0], corner[1] + LABEL), picture.shape[:2]
        self._picture(picture, place, size_within(room, picture), smooth=height != width)
