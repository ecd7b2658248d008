"""Take Cover with its fireballs painted out, or with those of another game in their place. Pages: takecover.md."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.runs.seeds import fold_seed
from dreamfleet.worker.worlds.takecover.game import Pixels, TakeCover

HORIZON = 40  # first row of the picture that fireballs reach; above it are the sky and its lights
OTHER_GAME = 1_000_003  # added to an episode's seed for the game whose fireballs it shows
Mask = NDArray[np.bool_]


def find_fireballs(picture: Pixels) -> Mask:
    """The pixels `(120, 160)` of fireballs, with one more at each edge.

    Their middle is brighter than anything else; orange that does not touch it is an imp's.
    """
    red, green, blue = (picture[..., channel].astype(np.int16) for channel in range(3))
    found = (red > 190) & (green > 150)
    found[:HORIZON] = False
    orange = (red > 150) & (green > 100) & (red - blue > 60)
    for _ in range(2):
        found |= _grown(found) & orange
    return _grown(found)


def _grown(mask: Mask) -> Mask:
    """The mask with its neighbours above, below and aside, corners included."""
    padded = np.pad(mask, 1)
    wide = padded[:, 2:] | padded[:, 1:-1] | padded[:, :-2]
    return wide[2:] | wide[1:-1] | wide[:-2]


def paint_out(picture: Pixels, mask: Mask) -> Pixels:
    """The picture with each pixel of `mask` as the last other one to its left, at the left edge as the first other."""
    painted, rows = picture.copy(), mask.any(axis=1)
    picture, mask = picture[rows], mask[rows]  # a screen has many rows without any
    columns = np.where(mask, -1, np.arange(mask.shape[1]))
    source = np.maximum.accumulate(columns, axis=1)
    source = np.where(source < 0, np.argmin(mask, axis=1)[:, None], source)
    painted[rows] = np.take_along_axis(picture, source[..., None], axis=1)
    return painted


class MaskedTakeCover(gymnasium.Wrapper[Pixels, int, Pixels, int]):
    """The same game, whose pictures hold no fireballs, or those of `other`, a game in which the same is done.

    On the screen that a person sees, where red hides their colours, games say themselves where their fireballs are.
    """

    def __init__(self, game: TakeCover, other: TakeCover | None) -> None:
        super().__init__(game)
        self._game, self._other = game, other
        self._foreign: Pixels | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Pixels, dict[str, Any]]:
        """Begin the episode of this seed."""
        picture, info = self.env.reset(seed=seed, options=options)
        if self._other is not None:
            self._foreign, _ = self._other.reset(seed=None if seed is None else fold_seed(seed) + OTHER_GAME)
        return self._painted(picture), info

    def step(self, action: int) -> tuple[Pixels, Any, bool, bool, dict[str, Any]]:
        """Do the same in both games; where the other one ends, another begins."""
        picture, reward, terminated, truncated, info = self.env.step(action)
        if self._other is not None:
            self._foreign, _, *ends, _ = self._other.step(action)
            if any(ends):
                self._foreign, _ = self._other.reset()
        return self._painted(picture), reward, terminated, truncated, info

    def close(self) -> None:
        """End both games' processes."""
        super().close()
        if self._other is not None:
            self._other.close()

    def _painted(self, picture: Pixels) -> Pixels:
        painted = paint_out(picture, _fireballs_of(self._game, picture))
        if self._other is not None and self._foreign is not None:
            there = _fireballs_of(self._other, self._foreign)
            painted[there] = self._foreign[there]
        return painted


def _fireballs_of(game: TakeCover, picture: Pixels) -> Mask:
    return find_fireballs(picture) if game.fireballs is None else game.fireballs
