"""Least squares over recorded drives, from what a world model sees and remembers of them.

`refit` and `fit_subspace` regress on [z, h]: the features of few drives at a time, summed into normal equations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.printable import plural
from dreamfleet.worker.scoring.rollout import DataWorld
from dreamfleet.worker.training.data.dataset import check_whole, kind_of, load_pictures, load_steps, pad
from dreamfleet.worker.worldmodel.inference import DreamStep, Encoder, RewardLabel
from dreamfleet.worker.worldmodel.observation import join_features

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
HELD_OUT_EVERY = 5  # every fifth drive measures R²; stages.py asks for as many
DRIVES_AT_ONCE = 16
PICTURES_AT_ONCE = 100  # of the encoder


@dataclass(frozen=True)
class DriveArrays:
    """A drive of T recorded steps: `pictures` (T, side, side, 3), `action` (T, actions), `reward` (T,)."""

    pictures: NDArray[np.uint8]
    action: Floats
    reward: Floats


class FeatureExtractor:
    """Computes what a controller of a world model would see along recorded drives."""

    def __init__(self, bundle: Bundle) -> None:
        self._encoder, self._memory, self._label = Encoder(bundle), DreamStep(bundle), RewardLabel(bundle)
        hidden = bundle.controller_shape.features > bundle.manifest.latent
        self._hidden = bundle.manifest.hidden if hidden else 0

    def encode_drives(self, drives: Sequence[DriveArrays]) -> Floats:
        """The latents of the drives' pictures `(N, T, latent)`, zero after a drive's end."""
        return pad([self._encode(drive.pictures) for drive in drives])

    def features(self, drives: Sequence[DriveArrays], latent: Floats) -> Floats:
        """[z, h], or z alone, before each step `(N, T, features)`; undefined after a drive's end."""
        action, reward = pad([drive.action for drive in drives]), pad([drive.reward for drive in drives])
        state, seen = self._memory.zero_state(len(drives)), []
        for step in range(latent.shape[1]):
            seen.append(join_features(latent[:, step], state, self._hidden))
            state = self._memory.advance(latent[:, step], action[:, step], state)
            self._label.write(state, reward[:, step].astype(np.float64))
        return np.stack(seen, axis=1)

    def _encode(self, pictures: NDArray[np.uint8]) -> Floats:
        starts = range(0, len(pictures), PICTURES_AT_ONCE)
        return np.concatenate([self._encoder.encode(pictures[start : start + PICTURES_AT_ONCE])[0] for start in starts])


@dataclass(frozen=True)
class LeastSquaresSums:
    """Sums for least squares on inputs X `(steps, inputs + 1)`, last column ones, and targets Y `(steps, outputs)`."""

    steps: int
    inputs: Doubles  # X'X
    cross: Doubles  # X'Y
    targets: Doubles  # sums of Y and of its squares `(2, outputs)`

    @classmethod
    def of(cls, inputs: Floats, targets: Doubles) -> LeastSquaresSums:
        """Sum over some steps; adds the column of ones to `inputs`."""
        wide = np.concatenate([inputs, np.ones((len(inputs), 1), np.float32)], axis=1).astype(np.float64)
        return cls(len(wide), wide.T @ wide, wide.T @ targets, np.stack([targets.sum(0), (targets**2).sum(0)]))

    def __add__(self, other: LeastSquaresSums) -> LeastSquaresSums:
        return LeastSquaresSums(
            self.steps + other.steps, self.inputs + other.inputs, self.cross + other.cross, self.targets + other.targets
        )

    def solve(self, ridge: float) -> Doubles:
        """The ridge solution `(inputs + 1, outputs)`; its last row, the offsets, is not penalised."""
        held = np.full(len(self.inputs), ridge * self.steps)
        held[-1] = 0
        return np.asarray(np.linalg.solve(self.inputs + np.diag(held), self.cross), dtype=np.float64)

    def r_squared(self, solved: Doubles) -> Doubles:
        """R² of each target `(outputs,)` under a solution; NaN for a target that does not vary."""
        missed = self.targets[1] - 2 * (solved * self.cross).sum(0) + (solved * (self.inputs @ solved)).sum(0)
        varies = self.targets[1] - self.targets[0] ** 2 / self.steps
        found: Doubles = np.full_like(varies, np.nan)
        np.divide(varies - missed, varies, out=found, where=varies > 1e-9 * self.steps)
        return found


class SplitSums:
    """Sums over drives in two parts: `fit`, and `held_out`, every fifth drive, to measure R²."""

    def __init__(self) -> None:
        self.fit = self.held_out = LeastSquaresSums(0, *np.zeros((3, 1)))

    def add(self, number: int, sums: LeastSquaresSums) -> None:
        """Add the sums of drive `number`, counted from 0."""
        if number % HELD_OUT_EVERY == HELD_OUT_EVERY - 1:
            self.held_out += sums
        else:
            self.fit += sums


def check_drives(paths: Sequence[Path], bundle: Bundle) -> None:
    """`DatasetError` for a damaged drive, or one of another world or other pictures than the bundle's."""
    check_whole(paths, "picture", "preprocessing", "world", "action", "reward", "ended")
    world, seen = DataWorld.of(bundle), bundle.manifest.preprocessing
    for path in paths:
        own, found = kind_of(path)
        if own != world:
            raise DatasetError(f"{path} is of {own}, and the world model of {world}")
        if found != seen:
            raise DatasetError(f"{path} holds pictures {found!r}, and the world model sees {seen!r}")


def load_in_batches(paths: Sequence[Path], actions: int) -> Iterator[tuple[int, list[DriveArrays]]]:
    """Yield the drives in batches, with the number of each batch's first drive."""
    for first in range(0, len(paths), DRIVES_AT_ONCE):
        yield first, [_load_drive(path, actions) for path in paths[first : first + DRIVES_AT_ONCE]]


def _load_drive(path: Path, actions: int) -> DriveArrays:
    steps, pictures = load_steps(path), load_pictures(path)
    if len(pictures) != len(steps["reward"]):
        raise DatasetError(f"{path} holds {plural(len(pictures), 'picture')} and another number of actions; delete it")
    if steps["action"].shape[1] != actions or not all(np.isfinite(steps[name]).all() for name in ("action", "reward")):
        raise DatasetError(
            f"{path} holds other actions than {plural(actions, 'number')} a step, or NaN or infinity; delete it"
        )
    return DriveArrays(pictures, steps["action"], steps["reward"])
