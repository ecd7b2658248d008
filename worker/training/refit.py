"""A controller for another world model: what it chooses on recorded drives, imitated there by least squares.

Weights on [z, h] mean nothing to another encoder's z, and little to an MDN-RNN's h once that has learnt on. So both
models follow the same drives, and the controller's first layer is fitted on what the new one sees and remembers to what
it gives on what its own does, before it is squashed: ridge regression, in closed form. Layers above stay as they are.
It is behavioural cloning (Pomerleau 1991) of a controller by itself, on states that others may have driven to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, ENCODER, Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError, DatasetError, UsageError
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.training.data.dataset import (
    check_whole,
    episode_paths,
    load_pictures,
    load_steps,
    pad,
    preprocessing_of,
)
from dreamfleet.worker.training.data.drive_steps import on_road_mask
from dreamfleet.worker.worldmodel.inference import DreamStep, Encoder, RewardLabel
from dreamfleet.worker.worldmodel.observation import join_features

RIDGE = 0.01  # against the mean square of a feature, which is below 1 for h and about 1 for what z tells
TANH_BOUND = 2.5  # tanh has 0.987 there: how much further a value lies makes no action
BOUND_MARGIN = 0.3  # how far behind its action's bound a value stays: a search can find the way back from there
HELD_OUT_EVERY = 5  # every fifth drive tells how well it went
DRIVES_AT_ONCE = 16  # drives that are followed at once
PICTURES_AT_ONCE = 100  # that are encoded at once

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class DriveArrays:
    """T recorded steps: `pictures` (T, side, side, 3), `action` (T, actions), `reward` (T,)."""

    pictures: NDArray[np.uint8]
    action: Floats
    reward: Floats


@dataclass(frozen=True)
class RefitResult:
    """The fitted controller; on how many drives and steps, and R² of each of the first layer's values on others."""

    controller: Controller
    drives: int
    steps: int
    r_squared: tuple[float, ...]


class FeatureExtractor:
    """What a controller of one world model would see while others drive."""

    def __init__(self, bundle: Bundle) -> None:
        self._encoder, self._memory, self._label = Encoder(bundle), DreamStep(bundle), RewardLabel(bundle)
        hidden = bundle.controller_shape.features > bundle.manifest.latent
        self._hidden = bundle.manifest.hidden if hidden else 0

    def encode_drives(self, drives: Sequence[DriveArrays]) -> Floats:
        """The latents of their pictures `(N, T, latent)`, zero behind a drive's end."""
        return pad([self._encode(drive.pictures) for drive in drives])

    def features(self, drives: Sequence[DriveArrays], latent: Floats) -> Floats:
        """[z, h], or z alone, before each step `(N, T, features)`; behind a drive's end they mean nothing."""
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
    """Everything that least squares ask of inputs X `(steps, inputs)` and targets Y `(steps, outputs)`."""

    steps: int
    inputs: Doubles  # X'X
    cross: Doubles  # X'Y
    targets: Doubles  # the sums of Y, and of its squares `(2, outputs)`

    @classmethod
    def of(cls, inputs: Floats, targets: Doubles) -> LeastSquaresSums:
        """Those of some steps; inputs have a last column of ones added."""
        wide = np.concatenate([inputs, np.ones((len(inputs), 1), np.float32)], axis=1).astype(np.float64)
        return cls(len(wide), wide.T @ wide, wide.T @ targets, np.stack([targets.sum(0), (targets**2).sum(0)]))

    def __add__(self, other: LeastSquaresSums) -> LeastSquaresSums:
        return LeastSquaresSums(
            self.steps + other.steps, self.inputs + other.inputs, self.cross + other.cross, self.targets + other.targets
        )

    def solve(self, ridge: float) -> Doubles:
        """The map `(inputs + 1, outputs)`; the offsets, its last row, are not held small."""
        held = np.full(len(self.inputs), ridge * self.steps)
        held[-1] = 0
        return np.asarray(np.linalg.solve(self.inputs + np.diag(held), self.cross), dtype=np.float64)

    def r_squared(self, solved: Doubles) -> Doubles:
        """How much of each target's variance a map tells `(outputs,)`; NaN of one that does not vary."""
        missed = self.targets[1] - 2 * (solved * self.cross).sum(0) + (solved * (self.inputs @ solved)).sum(0)
        varies = self.targets[1] - self.targets[0] ** 2 / self.steps
        found: Doubles = np.full_like(varies, np.nan)
        np.divide(varies - missed, varies, out=found, where=varies > 1e-9 * self.steps)
        return found


class SplitSums:
    """Sums over drives: of those that a map is fitted to, `used`, and of every fifth, which tells how well it went."""

    def __init__(self) -> None:
        self.used: LeastSquaresSums | None = None
        self.others: LeastSquaresSums | None = None

    def add(self, number: int, sums: LeastSquaresSums) -> None:
        """Those of the drive of this number, counted from 0."""
        side = "others" if number % HELD_OUT_EVERY == HELD_OUT_EVERY - 1 else "used"
        so_far = getattr(self, side)
        setattr(self, side, sums if so_far is None else so_far + sums)


def refit(
    controller: Controller, own: Bundle, bundle: Bundle, paths: Sequence[Path], on_progress: Callable[[int], None]
) -> RefitResult:
    """The controller of the world model `own` for `bundle`, by these drives; `on_progress` gets how many are followed.

    It is left as it is where that one sees and remembers as its own does, to the bit.

    `ControllerError` if the two worlds or their pictures differ; `DatasetError` if the drives have other pictures or
    actions or are damaged; `UsageError` if it looks at its own last choices, or if none of them keeps to its road.
    """
    if all(own.read(part) == bundle.read(part) for part in (ENCODER, DREAM_GRAPH)):
        return RefitResult(replace(controller, bundle=bundle.sha256), 0, 0, ())
    _check_compatible(controller, own, bundle, paths)
    fitted = bundle.with_controllers(
        bundle.shape_of(_feature_set(controller, own), controller.shape.hidden, controller.variant), controller.variant
    )
    old, new = FeatureExtractor(own.for_controller(controller)), FeatureExtractor(fitted)
    lowest, highest = output_bounds(controller, own)
    same_eyes = own.read(ENCODER) == bundle.read(ENCODER)
    (weights, biases), *above = controller.shape.unpack(controller.parameters)
    halves = SplitSums()
    for first, drives in load_in_batches(paths, own.manifest.actions):
        latent = old.encode_drives(drives)
        before, after = (
            old.features(drives, latent),
            new.features(drives, latent if same_eyes else new.encode_drives(drives)),
        )
        for row, drive in enumerate(drives):
            on = on_road_mask(drive.reward)
            wanted = before[row, : len(on)][on].astype(np.float64) @ weights.T.astype(np.float64) + biases
            sums = LeastSquaresSums.of(after[row, : len(on)][on], np.clip(wanted, lowest, highest))
            halves.add(first + row, sums)
        on_progress(first + len(drives))
    used, others = halves.used, halves.others
    if used is None or not used.steps:
        raise UsageError(f"none of the {len(paths)} drives keeps to its road: there is nothing to fit a controller to")
    r_squared = others.r_squared(used.solve(RIDGE)) if others and others.steps else np.full(len(biases), np.nan)
    whole = used + others if others else used
    solved = whole.solve(RIDGE)
    parts = [solved[:-1].T, solved[-1], *(part for layer in above for part in layer)]
    parameters = np.concatenate([part.ravel() for part in parts]).astype(np.float32)
    moved = replace(controller, shape=fitted.controller_shape, parameters=parameters, bundle=bundle.sha256,
                    provenance={"refitted_from": controller.sha256, "of_world_model": controller.bundle})  # fmt: skip
    return RefitResult(moved, len(paths), whole.steps, tuple(float(each) for each in r_squared))


def last_drives(folder: Path, count: int) -> list[Path]:
    """A folder's last drives, so many at most; those of controllers lie behind random ones."""
    return episode_paths(folder)[-count:]


def output_bounds(controller: Controller, own: Bundle) -> tuple[Doubles, Doubles]:
    """The values of the first layer `(outputs,)` below and above which nothing is told apart.

    An action that is cut off at a bound, such as a brake below 0, is the same however far behind it a value lies.
    Values that are compared, of choices, are told apart wherever they lie.
    """
    outputs = controller.shape.layers[0][0]
    lowest, highest = np.full(outputs, -TANH_BOUND), np.full(outputs, TANH_BOUND)
    actions = (
        controller.variant.controls if not controller.variant.is_default else find_task(own.manifest.task).world.actions
    )
    if isinstance(actions, Continuous) and actions.choices and not controller.shape.hidden:
        return lowest * np.inf, highest * np.inf
    if controller.shape.hidden or not isinstance(actions, Continuous) or actions.output_indices:
        return lowest, highest
    for output, (scale, shift, low, high) in enumerate(
        zip(actions.scale, actions.shift, actions.low, actions.high, strict=True)
    ):
        for bound, beyond in ((low, -1), (high, 1)):
            squashed = (bound - shift) / scale
            if abs(squashed) >= 1:
                continue  # tanh never comes there
            rest = math.atanh(squashed)
            if beyond * scale < 0:
                lowest[output] = max(lowest[output], rest - BOUND_MARGIN)
            else:
                highest[output] = min(highest[output], rest + BOUND_MARGIN)
    return lowest, highest


def output_names(controller: Controller, own: Bundle) -> tuple[str, ...]:
    """The outputs of a controller's first layer for people: actions where each has one of its own."""
    names, count = find_task(own.manifest.task).world.action_names, controller.shape.layers[0][0]
    plain = controller.variant.is_default or not (
        controller.variant.controls.output_indices or controller.variant.controls.choices
    )
    if plain and not controller.shape.hidden and len(names) == count:
        return names
    return tuple(f"output {number + 1}" for number in range(count))


def _feature_set(controller: Controller, own: Bundle) -> str:
    return "zh" if controller.shape.features > own.manifest.latent else "z"


def _check_compatible(controller: Controller, own: Bundle, bundle: Bundle, paths: Sequence[Path]) -> None:
    sees = [(each.manifest.task, each.manifest.preprocessing) for each in (own, bundle)]
    if sees[0] != sees[1]:
        raise ControllerError(
            f"the controller sees {sees[0][1]!r} of {sees[0][0]}, and {bundle.manifest.name} {sees[1][1]!r} of "
            f"{sees[1][0]}: no drive shows both"
        )
    if controller.variant.extra_features:
        raise UsageError("it looks at its own last choices, which no recorded drive holds: it cannot be refitted")
    check_drives(paths, sees[0][1])


def check_drives(paths: Sequence[Path], preprocessing: str) -> None:
    """`DatasetError` for a drive that is not whole, or holds other pictures than a model of these sees."""
    check_whole(paths, "picture", "preprocessing", "action", "reward", "ended")
    for path in paths:
        if (found := preprocessing_of(path)) != preprocessing:
            raise DatasetError(f"{path} holds pictures {found!r}, and the world model sees {preprocessing!r}")


def load_in_batches(paths: Sequence[Path], actions: int) -> Iterator[tuple[int, list[DriveArrays]]]:
    """The drives, few at a time, with the number of the first of them."""
    for first in range(0, len(paths), DRIVES_AT_ONCE):
        yield first, [_load_drive(path, actions) for path in paths[first : first + DRIVES_AT_ONCE]]


def _load_drive(path: Path, actions: int) -> DriveArrays:
    steps, pictures = load_steps(path), load_pictures(path)
    if len(pictures) != len(steps["reward"]):
        raise DatasetError(f"{path} holds {len(pictures)} pictures and another number of actions; delete it")
    if steps["action"].shape[1] != actions or not all(np.isfinite(steps[name]).all() for name in ("action", "reward")):
        raise DatasetError(f"{path} holds other actions than {actions} numbers a step, or NaN or infinity; delete it")
    return DriveArrays(pictures, steps["action"], steps["reward"])
