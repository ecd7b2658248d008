"""Pictures of any environment for world models: an exact resize, and wrappers that make one kind of environment of all.

A recordable task chains them in the order in which they stand here. What is left observes uint8 pictures
`(size, size, 3)` and takes float32 actions `(A,)`.
"""

from __future__ import annotations

from collections import deque
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
PICTURE_RANKS = (2, 3)
MIDDLE = 128  # the difference of equal pictures


def is_picture(space: Any) -> bool:
    """Whether a space holds pictures that `to_pixels` takes.

    >>> is_picture(spaces.Box(0, 255, (48, 40), np.uint8)), is_picture(spaces.Box(0, 255, (4,), np.uint8))
    (True, False)
    """
    if not isinstance(space, spaces.Box) or len(space.shape) not in PICTURE_RANKS or 0 in space.shape:
        return False
    if len(space.shape) == 3 and space.shape[2] not in (1, 3):
        return False
    floats = np.issubdtype(space.dtype, np.floating) and bool((space.low >= 0).all() and (space.high <= 1).all())
    return space.dtype == np.uint8 or floats


def to_pixels(picture: NDArray[Any]) -> Pixels:
    """The picture as uint8 `(H, W, 3)`; grey ones `(H, W)` or `(H, W, 1)` are repeated, floats are of 0 to 1.

    >>> to_pixels(np.full((1, 2), 0.5)).tolist()
    [[[128, 128, 128], [128, 128, 128]]]
    """
    pixels = picture if picture.dtype == np.uint8 else np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    return pixels if pixels.shape[2] == 3 else np.repeat(pixels, 3, axis=2)


def box_resize(picture: Pixels, size: int) -> Pixels:
    """A picture `(H, W, C)` as `(size, size, C)`, larger or smaller; the same bits on every host.

    A new pixel is the mean of the area that it covers, rounded to the nearest integer, halves up.

    >>> box_resize(np.array([[[0], [100], [200]]], np.uint8), 2)[0].ravel().tolist()
    [33, 167]
    """
    height, width, channels = picture.shape
    # Every sum is an integer that its type holds exactly, so BLAS may add in any order.
    exact = np.float32 if 255 * height * width < 2**24 else np.float64
    rows = _overlaps(height, size) @ picture.reshape(height, width * channels).astype(np.float32)
    columns = rows.reshape(size, width, channels).transpose(0, 2, 1).reshape(-1, width).astype(exact)
    sums = (columns @ _overlaps(width, size).T.astype(exact)).astype(np.int64).reshape(size, channels, size)
    area = height * width
    small: Pixels = ((sums + area // 2) // area).astype(np.uint8).transpose(0, 2, 1).copy()
    return small


@lru_cache(maxsize=64)
def _overlaps(length: int, size: int) -> Floats:
    """`(size, length)`: how much of each old pixel lies in each new one, in units that divide both."""
    new, old = np.arange(size)[:, None], np.arange(length)
    overlap = np.minimum((new + 1) * length, (old + 1) * size) - np.maximum(new * length, old * size)
    return np.array(np.clip(overlap, 0, None), dtype=np.float32)


class SkipFrames(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Repeats each action for `frames` steps, fewer if the episode ends, and adds their rewards.

    >>> with SkipFrames(gymnasium.make("CartPole-v1"), 4) as environment:
    ...     _ = environment.reset(seed=1)
    ...     environment.step(0)[1]
    4.0
    """

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


class CropAndResize(gymnasium.ObservationWrapper[Pixels, Any, NDArray[Any]]):
    """Observes uint8 `(size, size, 3)`: a part of each picture, or all of it, after `to_pixels` and `box_resize`.

    `UsageError` if the environment observes no pictures, or the part lies outside of them.

    >>> frame = gymnasium.spaces.Box(0, 255, (48, 40), np.uint8)
    >>> class Grey(gymnasium.Env):
    ...     observation_space, action_space = frame, gymnasium.spaces.Discrete(2)
    ...     def reset(self, *, seed=None, options=None):
    ...         return np.zeros((48, 40), np.uint8), {}
    >>> CropAndResize(Grey(), 64, crop=(8, 48, 0, 40)).reset()[0].shape
    (64, 64, 3)
    """

    def __init__(self, environment: gymnasium.Env[Any, Any], size: int, crop: Crop | None = None) -> None:
        super().__init__(environment)
        space = environment.observation_space
        if not is_picture(space):
            raise UsageError(
                f"what is observed is {space}, and a picture is uint8, or float from 0 to 1, of shape "
                "(height, width), (height, width, 1) or (height, width, 3)"
            )
        height, width = (space.shape or (0, 0))[:2]
        top, bottom, left, right = crop or (0, height, 0, width)
        if not (0 <= top < bottom <= height and 0 <= left < right <= width):
            raise UsageError(
                f"the crop {top}:{bottom},{left}:{right} is no part of a picture of {height} rows and {width} columns"
            )
        self._size, self._part = size, (slice(top, bottom), slice(left, right))
        self.observation_space = spaces.Box(0, 255, (size, size, 3), np.uint8)

    def observation(self, observation: NDArray[Any]) -> Pixels:
        """The picture."""
        return box_resize(to_pixels(np.asarray(observation)[self._part]), self._size)


class FrameDifference(gymnasium.Wrapper[Pixels, Any, Pixels, Any]):
    """Shows movement: of pictures `(H, W, 3)` it makes grey now, grey before, and `128 + (now - before) // 2`.

    Grey is `(77 R + 150 G + 29 B) >> 8`. After a reset, before is now.
    """

    def __init__(self, environment: gymnasium.Env[Any, Any]) -> None:
        super().__init__(environment)
        self._greys: deque[NDArray[np.int32]] = deque(maxlen=2)  # before and now

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Pixels, dict[str, Any]]:
        """Begin with a picture in which nothing moves."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._greys.append(_grey(observation))
        return self._observe(observation), info

    def step(self, action: Any) -> tuple[Pixels, Any, bool, bool, dict[str, Any]]:
        """The environment's step, with the difference to the picture before."""
        observation, *rest = self.env.step(action)
        return (self._observe(observation), *rest)  # type: ignore[return-value]

    def _observe(self, observation: Pixels) -> Pixels:
        self._greys.append(_grey(observation))
        before, now = self._greys
        return np.stack([now, before, MIDDLE + (now - before) // 2], axis=-1).astype(np.uint8)


def _grey(picture: Pixels) -> NDArray[np.int32]:
    red, green, blue = np.moveaxis(picture.astype(np.int32), -1, 0)
    return np.asarray((77 * red + 150 * green + 29 * blue) >> 8, dtype=np.int32)


class VectorActions(gymnasium.ActionWrapper[Any, Floats, Any]):
    """Takes float32 vectors `(A,)` as actions; `convert` makes of each what the simulator takes.

    `InvalidAction` for another shape or NaN.

    >>> one_of_two = Continuous((1, 1), (0, 0), (0, 0), (1, 1), choices=((1, 0), (0, 1)))
    >>> with VectorActions(gymnasium.make("CartPole-v1"), one_of_two, np.argmax) as environment:
    ...     _ = environment.reset(seed=1)
    ...     environment.step(np.array([0, 1], np.float32))[1]
    1.0
    """

    def __init__(
        self, environment: gymnasium.Env[Any, Any], actions: Continuous, convert: Callable[[Floats], Any]
    ) -> None:
        super().__init__(environment)
        self._convert = convert
        low, high = (np.array(each, dtype=np.float32) for each in (actions.low, actions.high))
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        self._shape = low.shape

    def action(self, action: Floats) -> Any:
        """The simulator's own action."""
        if np.shape(action) != self._shape or not np.isfinite(action).all():
            raise gymnasium.error.InvalidAction(f"an action is {self._shape[0]} finite numbers, not {action!r:.200}")
        return self._convert(action)
