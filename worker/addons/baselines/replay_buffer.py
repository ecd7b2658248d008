"""The replay buffer: whole episodes, sampled as traces of consecutive decisions, each episode also a file on disk."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.archives import ArchiveLimits, read_arrays
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.worker.addons.baselines.presets import LearningConfig
from dreamfleet.worker.training.data.data_folder import explain_write_errors

_LIMITS = ArchiveLimits(4 << 30, members=4)
KINDS = {"picture": "uint8", "choice": "int64", "reward": "float32"}


@dataclass(frozen=True)
class Episode:
    """T decisions: `picture` (T, side, side, 3) before each `choice` (T,), `reward` (T,) summed until the next one."""

    picture: NDArray[np.uint8]
    choice: NDArray[np.int64]
    reward: NDArray[np.float32]
    terminal: bool  # ended by the environment; false if truncated

    def __len__(self) -> int:
        return len(self.choice)

    def save(self, path: Path) -> None:
        """Write it atomically; `DatasetError` if it cannot be written."""
        with explain_write_errors(path), atomic_write(path) as file:
            np.savez_compressed(file, **{name: np.asarray(value) for name, value in vars(self).items()})  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: Path, picture: int) -> Episode:
        """Read one whose pictures have this side; `DatasetError` for a missing or damaged file, or another size."""
        try:
            arrays = read_arrays(path, _LIMITS, (*KINDS, "terminal"))
            terminal, length = bool(arrays.pop("terminal")), len(arrays["choice"])
            shapes = {"picture": (length, picture, picture, 3), "choice": (length,), "reward": (length,)}
            if {name: each.shape for name, each in arrays.items()} != shapes or not length:
                raise ValueError("its arrays are of other shapes")
            if {name: each.dtype.name for name, each in arrays.items()} != KINDS:
                raise ValueError("its arrays hold something else")
        except (OSError, ValueError, TypeError) as error:
            raise DatasetError(f"{path} is missing or damaged ({error}): give --new to start over") from error
        return cls(**arrays, terminal=terminal)


@dataclass(frozen=True)
class TraceBatch:
    """N traces, each from one episode: B decisions of burn-in, L to learn from, n more for the n-step target.

    Entries outside the episode are zero; `real` is 0 for a burn-in step before its beginning.
    """

    picture: NDArray[np.uint8]  # (N, B + L + n, side, side, 3)
    real: NDArray[np.float32]  # (N, B)
    choice: NDArray[np.int64]  # (N, L)
    value: NDArray[np.float32]  # (N, L), as `Returns.value`; likewise `discount`
    discount: NDArray[np.float32]  # (N, L)
    mask: NDArray[np.float32]  # (N, L), `Returns.known` as 0 or 1


class ReplayBuffer:
    """The latest whole episodes: at most `config.replay` decisions, but always one episode."""

    def __init__(self, config: LearningConfig) -> None:
        self._config = config
        self._episodes: deque[tuple[Episode, Returns]] = deque()
        self._decisions = 0

    def __len__(self) -> int:
        return len(self._episodes)

    def add(self, episode: Episode) -> None:
        """Add a whole episode and drop the oldest ones beyond the capacity."""
        config = self._config
        returns = n_step(episode.reward, episode.terminal, config.gamma, config.n_step)
        self._episodes.append((episode, returns))
        self._decisions += len(episode)
        while self._decisions > config.replay and len(self._episodes) > 1:
            self._decisions -= len(self._episodes.popleft()[0])

    def sample(self, random: np.random.Generator) -> TraceBatch | None:
        """Sample a batch of traces, episodes in proportion to their length; `None` while no decision has a target."""
        usable = np.array([int(returns.known.sum()) for _, returns in self._episodes])
        if not usable.any():
            return None
        found = random.choice(len(usable), self._config.batch, p=usable / usable.sum())
        rows = [self._trace(*self._episodes[each], random) for each in found]
        return TraceBatch(*(np.stack([getattr(row, each.name) for row in rows]) for each in fields(TraceBatch)))

    def _trace(self, episode: Episode, returns: Returns, random: np.random.Generator) -> TraceBatch:
        config = self._config
        last = max(0, int(returns.known.sum()) - config.trace)
        start = int(random.integers(last + 1))
        first, end = start - config.burn_in, start + config.trace
        return TraceBatch(
            slice_padded(episode.picture, first, end + config.n_step),
            (np.arange(first, start) >= 0).astype(np.float32),
            slice_padded(episode.choice, start, end),
            slice_padded(returns.value, start, end),
            slice_padded(returns.discount, start, end),
            slice_padded(returns.known, start, end).astype(np.float32),
        )


def slice_padded(array: NDArray[Any], first: int, end: int) -> NDArray[Any]:
    """Rows `first` to `end` (exclusive) of an episode's array, with zeros for rows outside it."""
    out = np.zeros((end - first, *array.shape[1:]), array.dtype)
    begin, stop = max(first, 0), min(end, len(array))
    out[begin - first : stop - first] = array[begin:stop]
    return out


def first_in_replay(lengths: list[int], most: int) -> int:
    """Index of the oldest episode to keep: from it on all episodes hold at most `most` decisions. The last is kept."""
    total = 0
    for index in range(len(lengths) - 1, -1, -1):
        total += lengths[index]
        if total > most and index < len(lengths) - 1:
            return index + 1
    return 0


Floats = NDArray[np.float32]


class Returns(NamedTuple):
    """The n-step returns of an episode of T decisions, each field `(T,)`."""

    value: Floats  # discounted sum of the next n rewards, fewer at the episode's end
    discount: Floats  # factor of the Q value n decisions later; 0 if the episode is over by then
    known: NDArray[np.bool_]  # false if the episode was truncated within the n decisions


def n_step(reward: NDArray[Any], terminal: bool, gamma: float, n: int) -> Returns:
    """Sutton & Barto 2018, equation 7.1: R_t = r_t + gamma r_t+1 + ... + gamma^(n-1) r_t+n-1, then gamma^n Q(t + n).

    After a terminal no Q value follows. If the episode was truncated, by the step limit or by patience, the last n
    decisions have no recorded successor, so they are not learnt from.
    """
    length = len(reward)
    padded = np.concatenate([np.asarray(reward, np.float64), np.zeros(n)])
    value = sum((gamma**ahead * padded[ahead : ahead + length] for ahead in range(n)), np.zeros(length))
    followed = np.arange(length) + n < length
    discount = np.where(followed, gamma**n, 0.0)
    return Returns(value.astype(np.float32), discount.astype(np.float32), followed | terminal)
