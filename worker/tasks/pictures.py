"""Pictures of any environment for world models: an exact resize, and wrappers that make one kind of environment of all.

A recordable task chains them in the order in which they stand here. What is left observes uint8 pictures
`(size, size, 3)` and takes float32 actions `(A,)`. Pages: worlds.md, own-world-model.md.
"""

import math
import re
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.errors import UsageError

Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]
Crop = tuple[int, int, int, int]  # first row, row after the last, first column, column after the last
_CROP = re.compile(r"(\d{1,5}):(\d{1,5}),(\d{1,5}):(\d{1,5})", re.ASCII)
SHORTEST = 8  # pixels of a side; smaller boxes hold codes, such as MiniGrid's of 7x7 cells
MIDDLE = 128  # the difference of equal pictures
COLOURS = (1, 3, 4)  # channels: grey, colours, colours and opacity
MOST_FRAMES = 16  # of a stack
AXES = ("HW", "HWC", "CHW", "NHW", "NHWC", "NCHW")  # of pictures that are taken, in the order in which they are tried
KINDS = (
    "uint8 up to 255, or float from 0 to 1, of shape (height, width), with 1, 3 or 4 colours behind or 1 or 3 before, "
    f"or a stack of up to {MOST_FRAMES} of these; at least {SHORTEST} pixels a side"
)


def parse_crop(text: str) -> Crop | None:
    """The crop of `top:bottom,left:right`; `None` if the text is none."""
    if (found := _CROP.fullmatch(text)) is None:
        return None
    top, bottom, left, right = map(int, found.groups())
    return top, bottom, left, right


def is_crop(crop: Crop, height: int, width: int) -> bool:
    """Whether a crop is a part of a picture of this size that is large enough to be seen: of 8 pixels a side."""
    top, bottom, left, right = crop
    return 0 <= top <= bottom - SHORTEST <= height - SHORTEST and 0 <= left <= right - SHORTEST <= width - SHORTEST


def find_axes(shape: tuple[int, ...]) -> str:
    """What the axes of a picture of this shape are: frames N, height H, width W, colours C; empty if it is none.

    A picture has at least 8 pixels a side, 1, 3 or 4 colours (the last is how opaque it is), and a stack up to 16
    frames. `(H, W, 4)` is one picture with opacity; `(4, H, W)` is a stack of four grey ones, as gymnasium stacks.

    >>> [find_axes(shape) for shape in ((48, 40), (48, 40, 3), (3, 48, 40), (4, 48, 40), (2, 48, 40, 3), (5, 5))]
    ['HW', 'HWC', 'CHW', 'NHW', 'NHWC', '']
    """
    for axes in AXES:
        if len(axes) != len(shape):
            continue
        sizes = dict(zip(axes, shape, strict=True))
        is_large = min(sizes["H"], sizes["W"]) >= SHORTEST
        has_colours = sizes.get("C", 1) in (COLOURS if axes[-1] == "C" or "N" in axes else COLOURS[:2])
        if is_large and has_colours and 1 <= sizes.get("N", 1) <= MOST_FRAMES:
            return axes
    return ""


def is_picture(space: Any) -> bool:
    """Whether a space holds pictures that `cut_and_resize` takes: uint8 up to 255, or floats from 0 to 1.

    Whole numbers that stay below half of that are codes, such as those of a board.
    """
    if not isinstance(space, spaces.Box) or not find_axes(space.shape):
        return False
    if space.dtype == np.uint8:
        return bool(space.high.max() >= MIDDLE)
    return np.issubdtype(space.dtype, np.floating) and bool((space.low >= 0).all() and (space.high <= 1).all())


def to_pixels(picture: NDArray[Any]) -> Pixels:
    """The picture as uint8 `(H, W, 3)`; grey ones `(H, W)` or `(H, W, 1)` are repeated, floats are of 0 to 1.

    Opacity is left out. `ValueError` for floats beyond 0 to 1, or NaN.
    """
    if picture.dtype != np.uint8:
        levels = np.rint(picture * 255)
        if not ((levels >= 0) & (levels <= 255)).all():  # also NaN
            found = "NaN" if np.isnan(picture).any() else f"{picture.min()} to {picture.max()}"
            raise ValueError(f"a picture of {picture.dtype} has values from 0 to 1, not {found}")
        picture = levels.astype(np.uint8)
    pixels = picture
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    return pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2)


def drawn_pixels(drawn: Any) -> Pixels | None:
    """What an environment's `render` returned as uint8 `(H, W, 3)`; `None` if it is no picture.

    Any numbers are taken: floats up to 1 are scaled to 255, others are cut at 0 and 255. Of several pictures the last
    counts.
    """
    if isinstance(drawn, (list, tuple)) and drawn and isinstance(drawn[-1], np.ndarray):
        drawn = drawn[-1]
    if not isinstance(drawn, np.ndarray) or drawn.dtype.kind not in "buif" or 0 in drawn.shape:
        return None
    one = last_frame(drawn)
    if one.ndim not in (2, 3) or one.shape[2:] not in ((), *((each,) for each in COLOURS)):
        return None
    if one.dtype != np.uint8:
        whole = one.dtype.kind in "ui" or not (one <= 1).all()
        levels = np.nan_to_num(one.astype(np.float64)) * (1 if whole else 255)
        one = np.rint(levels).clip(0, 255).astype(np.uint8)
    return to_pixels(one)


def last_frame(picture: NDArray[Any]) -> NDArray[Any]:
    """A picture of any of the layouts as `(H, W)` or `(H, W, C)`: the last frame of a stack.

    >>> last_frame(np.zeros((3, 48, 40))).shape, last_frame(np.zeros((4, 48, 40))).shape
    ((48, 40, 3), (48, 40))
    """
    axes = find_axes(picture.shape)
    if "N" in axes:
        picture, axes = picture[-1], axes[1:]
    return np.moveaxis(picture, 0, -1) if axes == "CHW" else picture


def tile_frames(stack: NDArray[Any]) -> NDArray[Any]:
    """All frames of a stack as one picture: in reading order, in as many columns as rows, or one more.

    >>> tile_frames(np.zeros((4, 48, 40))).shape, tile_frames(np.zeros((2, 3, 48, 40))).shape
    ((96, 80), (48, 80, 3))
    """
    if "N" not in find_axes(stack.shape):
        return stack
    frames = np.stack([last_frame(each) for each in stack])
    columns = math.ceil(math.sqrt(len(frames)))
    rows = -(-len(frames) // columns)
    filled = np.concatenate([frames, np.zeros((rows * columns - len(frames), *frames.shape[1:]), frames.dtype)])
    lines = [np.concatenate(list(filled[start : start + columns]), axis=1) for start in range(0, len(filled), columns)]
    return np.concatenate(lines)


def box_resize(picture: Pixels, size: int) -> Pixels:
    """A picture `(H, W, C)` as `(size, size, C)`, larger or smaller; the same bits on every host.

    A new pixel is the mean of the area that it covers, rounded to the nearest integer, halves up.
    """
    height, width, channels = picture.shape
    area = height * width
    exact = np.int32 if 255 * area + area // 2 < 2**31 else np.int64
    rows = _area_sums(picture.reshape(height, width * channels), size, np.int32)
    columns = rows.reshape(size, width, channels).transpose(1, 0, 2).reshape(width, size * channels)
    means = (_area_sums(columns, size, exact) + area // 2) // area
    return np.ascontiguousarray(means.astype(np.uint8).reshape(size, size, channels).transpose(1, 0, 2))


def _area_sums(values: NDArray[Any], size: int, exact: type[np.signedinteger[Any]]) -> NDArray[Any]:
    """Rows `(n, m)` as `(size, m)`: each the sum of the rows that it covers, times how much of each, in type `exact`.

    A matrix product would be the same, but its threads wait for each other on a busy host, 40 ms for one picture.
    """
    old, overlap = _overlaps(len(values), size)
    sums = np.zeros((size, values.shape[1]), exact)
    for covered, weights in zip(old, overlap, strict=True):
        sums += weights[:, None].astype(exact) * values[covered]
    return sums


@lru_cache(maxsize=64)
def _overlaps(length: int, size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The old rows that each new one covers, `(most of them, size)`, and how much of each in a common unit."""
    new = np.arange(size)
    first, last = new * length // size, ((new + 1) * length - 1) // size
    old = first + np.arange((last - first).max() + 1)[:, None]
    overlap = np.minimum((new + 1) * length, (old + 1) * size) - np.maximum(new * length, old * size)
    return np.minimum(old, length - 1), np.maximum(overlap, 0)


def cut_and_resize(picture: NDArray[Any], size: int, crop: Crop | None = None) -> Pixels:
    """A picture of a space for which `is_picture`, or its part `crop`, as `(size, size, 3)`; of a stack the last."""
    seen = last_frame(picture)
    top, bottom, left, right = crop or (0, *seen.shape[:1], 0, *seen.shape[1:2])
    return box_resize(to_pixels(seen[top:bottom, left:right]), size)


def frame_difference(now: Pixels, before: Pixels) -> Pixels:
    """Two pictures `(H, W, 3)` as one: grey now, grey before, and `128 + (now - before) // 2`.

    Grey is `(77 R + 150 G + 29 B) >> 8`.

    >>> frame_difference(np.full((1, 1, 3), 20, np.uint8), np.full((1, 1, 3), 10, np.uint8)).tolist()
    [[[20, 10, 133]]]
    """
    red, green, blue = np.moveaxis(np.stack([now, before]).astype(np.int32), -1, 0)
    greys = (77 * red + 150 * green + 29 * blue) >> 8
    return np.stack([*greys, MIDDLE + (greys[0] - greys[1]) // 2], axis=-1).astype(np.uint8)


class SkipFrames(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Repeats each action for `frames` steps, fewer if the episode ends, and adds their rewards."""

    def __init__(self, environment: gymnasium.Env[Any, Any], frames: int) -> None:
        super().__init__(environment)
        if frames < 1:
            raise UsageError(f"an action is held for at least 1 step, not {frames}")
        self._frames = frames

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """The last of the steps, with the sum of their rewards."""
        total = 0.0
        for _ in range(self._frames):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


class LookAtDrawn(gymnasium.Wrapper[Pixels, Any, Any, Any]):
    """Observes what the environment draws, uint8 `(H, W, 3)`; `UsageError` if it draws no pictures."""

    def __init__(self, environment: gymnasium.Env[Any, Any]) -> None:
        super().__init__(environment)
        environment.reset()
        shape = self._draw().shape
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Pixels, dict[str, Any]]:
        """The environment's reset, and what it draws then."""
        info = self.env.reset(seed=seed, options=options)[1]
        return self._draw(), info

    def step(self, action: Any) -> tuple[Pixels, Any, bool, bool, dict[str, Any]]:
        """The environment's step, and what it draws then."""
        _, reward, terminated, truncated, info = self.env.step(action)
        return self._draw(), reward, terminated, truncated, info

    def _draw(self) -> Pixels:
        drawn = self.env.render()
        found = drawn_pixels(drawn)
        if found is None:
            raise UsageError(f"its `render` returns {type(drawn).__name__}, not an array (height, width, 3)")
        return found


class CropAndResize(gymnasium.ObservationWrapper[Pixels, Any, NDArray[Any]]):
    """Observes uint8 `(size, size, 3)`: a part of each picture, or all of it, as `cut_and_resize` makes it.

    `UsageError` if the environment observes no pictures, or the part lies outside of them.
    """

    def __init__(self, environment: gymnasium.Env[Any, Any], size: int, crop: Crop | None = None) -> None:
        super().__init__(environment)
        space = environment.observation_space
        if not is_picture(space):
            raise UsageError(f"what is observed is {space}, and a picture is {KINDS}")
        axes = find_axes(space.shape or ())
        height, width = (space.shape or ())[axes.index("H")], (space.shape or ())[axes.index("W")]
        top, bottom, left, right = crop or (0, height, 0, width)
        if not is_crop((top, bottom, left, right), height, width):
            raise UsageError(
                f"the crop {top}:{bottom},{left}:{right} is not within a picture of {height} rows and {width} columns "
                f"with at least {SHORTEST} of each"
            )
        self._size, self._crop = size, (top, bottom, left, right)
        self._shape, self._kind = space.shape, np.dtype(space.dtype).kind
        self.observation_space = spaces.Box(0, 255, (size, size, 3), np.uint8)

    def observation(self, observation: NDArray[Any]) -> Pixels:
        """The picture; `ValueError` for one of another shape or kind of number than the environment declares."""
        seen = np.asarray(observation)
        if seen.shape != self._shape or seen.dtype.kind != self._kind or (self._kind == "u" and seen.itemsize != 1):
            raise ValueError(f"a picture is {seen.dtype} {seen.shape}, and its space is {self.env.observation_space}")
        return cut_and_resize(seen, self._size, self._crop)


class FrameDifference(gymnasium.Wrapper[Pixels, Any, Pixels, Any]):
    """Shows movement: observes `frame_difference` of each picture and the one before; after a reset they are equal."""

    def __init__(self, environment: gymnasium.Env[Any, Any]) -> None:
        super().__init__(environment)
        self._before = np.zeros((0, 0, 3), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Pixels, dict[str, Any]]:
        """Begin with a picture in which nothing moves."""
        self._before, info = self.env.reset(seed=seed, options=options)
        return frame_difference(self._before, self._before), info

    def step(self, action: Any) -> tuple[Pixels, Any, bool, bool, dict[str, Any]]:
        """The environment's step, with the difference to the picture before."""
        now, reward, terminated, truncated, info = self.env.step(action)
        before, self._before = self._before, now
        return frame_difference(now, before), reward, terminated, truncated, info


class VectorActions(gymnasium.ActionWrapper[Any, Floats, Any]):
    """Takes float32 vectors `(A,)` as actions; `convert` makes of each what the simulator takes.

    `InvalidAction` for another shape or NaN.
    """

    def __init__(
        self, environment: gymnasium.Env[Any, Any], actions: Continuous, convert: Callable[[Floats], Any]
    ) -> None:
        super().__init__(environment)
        self.actions = actions
        self._convert = convert
        low, high = (np.array(each, dtype=np.float32) for each in (actions.low, actions.high))
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        self._shape = low.shape

    def action(self, action: Floats) -> Any:
        """The simulator's own action."""
        if np.shape(action) != self._shape or not np.isfinite(action).all():
            raise gymnasium.error.InvalidAction(f"an action is {self._shape[0]} finite numbers, not {action!r:.200}")
        return self._convert(action)
