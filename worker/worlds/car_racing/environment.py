"""gymnasium's CarRacing-v3 in our own native code: track, physics, rewards and picture equal its to the bit.

Where Box2D and pygame are, gymnasium's own environment can go beside ours (`reference.Shadow`): it draws what people
see (`rgb_array`, `human`), and where scores are reported it judges, and an episode stops at the first difference.
Pages: platforms.md.
"""

from __future__ import annotations

import logging
import math
from functools import cache, lru_cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled, InvalidAction
from numpy.typing import NDArray

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host.packages import allow_swig_types
from dreamfleet.common.printable import plural
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX, RAW, find_preprocessing

try:
    from dreamfleet.worker.worlds.car_racing import _native
    from dreamfleet.worker.worlds.car_racing.car import Car, read_car
except ImportError:  # no compiler when this was installed
    _native = None  # type: ignore[assignment]

log = logging.getLogger(__name__)
PICTURES = "DREAMFLEET_PICTURES"  # "gymnasium" lets gymnasium draw, in this process and those that it starts
DRAWS = np.tile((0.0, 150 / 3), 12), np.tile((2 * math.pi / 12, 150.0), 12)  # bounds of a track's random numbers
COLOURS = tuple(np.array(each, float) for each in ((102, 102, 102), (102, 204, 102), (102, 230, 102)))
CHOICES = ((-0.0, 0.0, 0.0), (0.6, 0.0, 0.0), (-0.6, 0.0, 0.0), (-0.0, 0.2, 0.0), (-0.0, 0.0, 0.8))  # discrete actions
ENLARGED = 6  # times, of the observation that stands for gymnasium's large picture


class CarRacing(gymnasium.Env[Any, Any], gymnasium.utils.EzPickle):
    """CarRacing-v3, driven and drawn natively; `DreamfleetError` where the native module was not built.

    `preprocessing` names its pictures: `raw-96`, gymnasium's own, or another of `car_racing.preprocessing`. Like
    gymnasium's, it is not thread-safe: environments of one process share one canvas.

    With `checked` N, gymnasium's environment drives along where it can be imported: `DreamfleetError` if a reward or
    an end differs, or the first picture or every Nth one.
    """

    metadata = {"render_modes": ["human", "rgb_array", "state_pixels"], "render_fps": 50}  # noqa: RUF012 - gymnasium's
    drawn_by = "native"

    def __init__(
        self, render_mode: str | None = None, verbose: bool = False, lap_complete_percent: float = 0.95,
        domain_randomize: bool = False, continuous: bool = True, *, preprocessing: str = RAW.name, checked: int = 0,
    ) -> None:  # fmt: skip
        if _native is None:
            raise DreamfleetError("no native module was built: install a C compiler, then this package again")
        settings = (render_mode, verbose, lap_complete_percent, domain_randomize, continuous)
        gymnasium.utils.EzPickle.__init__(self, *settings, preprocessing=preprocessing, checked=checked)
        self.render_mode, self.continuous, self.domain_randomize = render_mode, continuous, domain_randomize
        self.lap_complete_percent = lap_complete_percent
        self.race, self.track = _native.Race(), list[tuple[float, float, float, float]]()
        self._preprocessing, self._checked, self._drawn = find_preprocessing(preprocessing), checked, 0
        self.colours = self._choose_colours() if domain_randomize else COLOURS
        self.observation_space = spaces.Box(0, 255, self._preprocessing.shape, np.uint8)
        self.action_space = spaces.Box(np.array([-1, 0, 0], np.float32), np.ones(3, np.float32))
        if not continuous:
            self.action_space = spaces.Discrete(5)  # nothing, right, left, gas, brake
        reference = find_reference() if checked or render_mode not in (None, "state_pixels") else None
        self.shadow: Any = reference.Shadow(*settings) if reference else None
        if render_mode not in (None, "state_pixels") and self.shadow is None:
            if render_mode == "human":
                raise DependencyNotInstalled("the render mode human needs Box2D and pygame")
            log.warning("Box2D or pygame is missing: pictures for people are the observation with larger pixels")

    @property
    def car(self) -> Car:
        """The car as it is now, under gymnasium's names."""
        return read_car(self.race)

    @property
    def t(self) -> float:
        """Seconds since the reset, which the camera's zoom follows for one second."""
        return self.race.time

    @t.setter
    def t(self, value: float) -> None:
        self.race.time = value
        if self.shadow is not None:
            self.shadow.t = value

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Begin on the track of a seed; without one, on the next random track."""
        super().reset(seed=seed)
        if self.shadow is not None:
            self.shadow.begin(self, options)
        if self.domain_randomize and (not isinstance(options, dict) or options.get("randomize", True)):
            self.colours = self._choose_colours()
        while not self.race.reset(self.np_random.uniform(*DRAWS), self.lap_complete_percent, np.array(self.colours)):
            pass  # these numbers gave no closed road
        self.track = self.race.track()
        self._drawn = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Gymnasium's step; `InvalidAction` for an action of another shape or with NaN, before anything moves."""
        reward, finished = 0.0, None
        if action is None:
            self.race.idle()
        elif self.continuous:
            action = np.asarray(action)
            reward, finished = self.race.step(*controls(action))
        elif self.action_space.contains(action):
            reward, finished = self.race.step(*CHOICES[action])
        else:
            raise InvalidAction(f"an action is one of {self.action_space}, not {action!r}")
        info = {} if finished is None else {"lap_finished": finished}
        if self.shadow is not None:
            self._follow(action, reward, info)
        return self._observe(), reward, bool(info), False, info

    def place(self, angle: float, x: float, y: float) -> None:
        """Put a new car, standing still, at a place."""
        self.race.place(angle, x, y)
        if self.shadow is not None:
            self.shadow.place(angle, x, y)

    def render(self) -> Any:
        """Gymnasium's picture; where Box2D or pygame is missing, the observation with larger pixels."""
        if self.shadow is not None:
            return self.shadow.render()
        if self.render_mode is None:
            gymnasium.logger.warn("render needs a render_mode, which is given when the environment is made")
            return None
        observation = self._draw(RAW.shape)
        scale = 1 if self.render_mode == "state_pixels" else ENLARGED
        return observation.repeat(scale, axis=0).repeat(scale, axis=1)

    def close(self) -> None:
        """Close gymnasium's window."""
        if self.shadow is not None:
            self.shadow.close()

    def _choose_colours(self) -> tuple[NDArray[np.float64], ...]:
        """Random ones, as gymnasium draws them: the road's, the field's and its patches'."""
        road, field = self.np_random.uniform(0, 210, size=3), self.np_random.uniform(0, 210, size=3)
        patches = field.copy()
        patches[self.np_random.integers(3)] += 20
        return road, field, patches

    def _follow(self, action: Any, reward: float, info: dict[str, Any]) -> None:
        _, theirs, *_, their_info = self.shadow.step(action)
        if (reward, info) != (theirs, their_info):
            raise self._difference(f"the reward {reward} with {info} is {theirs} with {their_info} there")

    def _observe(self) -> NDArray[np.uint8]:
        """The picture of the preprocessing, compared if it is due."""
        if self._preprocessing is BOX:
            picture = self._draw(BOX.shape)
        else:
            picture = self._preprocessing.picture(self._draw(RAW.shape))
        if self._checked and self.shadow is not None:
            if self._drawn % self._checked == 0:
                theirs = self._preprocessing.picture(self.shadow.observe())
                if different := int((picture != theirs).any(axis=-1).sum()):
                    raise self._difference(f"the picture differs by {plural(different, 'pixel')}")
            self._drawn += 1
        return picture

    def _difference(self, what: str) -> DreamfleetError:
        return DreamfleetError(
            f"the native environment is not gymnasium's: {what}, so its scores would be others: set "
            f"`{PICTURES}=gymnasium`, and gymnasium drives and draws; please report this, with the versions of "
            "gymnasium, Box2D and pygame"
        )

    def _draw(self, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """The picture of this shape: gymnasium's observation `(96, 96, 3)`, or the small one of its scene."""
        out = np.empty(shape, np.uint8)
        self.race.draw(out)
        if shape == RAW.shape:
            text = render_score(f"{self.race.shown:04.0f}")
            out[84:, : text.shape[1]] = text
        return out


def controls(action: NDArray[Any]) -> list[float]:
    """Steering, gas and brake; `InvalidAction` if that is not what an action is."""
    values: list[float] = action.tolist()
    if action.shape != (3,) or not all(map(math.isfinite, values)):
        raise InvalidAction(f"an action is three finite numbers (steering, gas, brake), not {action!r}")
    return values


def is_native_available() -> bool:
    """Whether the native module was built."""
    return _native is not None


@cache
def find_reference() -> ModuleType | None:
    """The module `reference`, with gymnasium's own environment; `None` where Box2D or pygame cannot be imported."""
    allow_swig_types()  # again: who imported us may have put the filters of warnings back
    try:
        return import_module("dreamfleet.worker.worlds.car_racing.reference")
    except (ImportError, DependencyNotInstalled) as error:
        log.info("gymnasium's CarRacing cannot be imported: %s", error)
        return None


# ---- the score's text, which pygame writes: its pixels are kept for all scores of usual episodes ----

TEXTS = ("-000", *(f"{score:04.0f}" for score in range(-400, 1001)))
TEXT_WIDTH = 125  # pixels at the window's left edge that hold the score: exactly twelve of the observation's


@lru_cache(maxsize=4096)
def render_score(text: str) -> NDArray[np.uint8]:
    """The score's text as pixels `(12, 12, 3)`: the observation's rows 84-95, columns 0-11."""
    found = _kept_texts().get(text)
    return write_score(text) if found is None else np.repeat(found[:, :, None], 3, axis=2)


@cache
def _kept_texts() -> dict[str, NDArray[np.uint8]]:
    with np.load(Path(__file__).with_name("scores.npz")) as kept:
        return dict(zip(TEXTS, kept["pixels"], strict=True))


def write_score(text: str) -> NDArray[np.uint8]:
    """The same as pygame writes it now."""
    import pygame

    pygame.font.init()
    image = pygame.font.Font(pygame.font.get_default_font(), 42).render(text, True, (255, 255, 255), (0, 0, 0))
    place = image.get_rect()
    place.center = (60, int(800 - 800 * 2.5 / 40.0))
    surface = pygame.Surface((TEXT_WIDTH, 800))
    surface.blit(image, place)
    small = pygame.transform.smoothscale(surface, (12, 96))
    return np.array(pygame.surfarray.pixels3d(small)[:, 84:].transpose(1, 0, 2), order="C")
