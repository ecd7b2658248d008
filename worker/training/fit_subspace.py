"""A subspace for a search: what a driver will do and earn, as far as a world model's [z, h] foretells it linearly.

Recorded drives are their own teachers: for each moment, what was done in windows of the following steps, how large
that was, and what was earned, are regressed on what the model saw and remembered before, by ridge regression (Hoerl
and Kennard 1970) in closed form. What is foretold at all is a feature: the direction of [z, h] that foretells, say,
how sharply will be steered half a second from now.

What a driver makes good at once, such as its place on the road, shows in nothing that it does later. So the model's own
view of the near future can be asked for too: the directions of [z, h] that are best correlated with [z, h] some steps
later, by canonical correlations (Hotelling 1936).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.training.data.drive_steps import FIRST_START, on_road_mask
from dreamfleet.worker.training.drive_regression import (
    HELD_OUT_EVERY,
    DriveArrays,
    FeatureExtractor,
    LeastSquaresSums,
    SplitSums,
    check_drives,
    load_in_batches,
)

RIDGE = 0.001  # against the mean square of a feature; see `refit`
ACTION_WINDOWS = (
    (0, 3),
    (3, 8),
    (8, 15),
    (15, 22),
    (22, 30),
    (30, 40),
)  # steps from now on, in which an action is asked for
NEXT_WINDOW = (0, 5)
REWARD_WINDOWS = ((0, 6), (6, 20), (20, 40))  # and the reward
LEAST_STEPS = 500  # that count, of all drives: a model sees hundreds of numbers
MIN_R_SQUARED = 0.05  # R² on held-out drives of what counts as foretold
VIEW_STEPS = 15  # steps until [z, h] is asked for again

Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class SubspaceResult:
    """The subspace, R² of each of its features on held-out drives; of how many drives and steps."""

    subspace: Subspace
    r_squared: tuple[float, ...]
    drives: int
    steps: int


@dataclass(frozen=True)
class PredictionTarget:
    """One thing to foretell: the mean of a column over a window of steps, or its size."""

    name: str
    column: int  # of actions; behind them the reward
    window: tuple[int, int]
    size: bool = False

    def values(self, sums: Doubles) -> Doubles:
        """At each step `(T,)` of a drive, by the running sums of its columns `(T + 1, columns)`; cut at its end."""
        steps = len(sums) - 1
        start, end = (np.minimum(np.arange(steps) + each, steps) for each in self.window)
        mean: Doubles = (sums[end, self.column] - sums[start, self.column]) / (self.window[1] - self.window[0])
        return np.abs(mean) if self.size else mean


def make_targets(world: World, columns: int) -> list[PredictionTarget]:
    """What is asked for of so many actions: all windows of one that goes both ways, of others what comes next."""
    actions, found = world.actions, []
    for column in range(columns):
        name = world.action_names[column] if column < len(world.action_names) else f"action {column + 1}"
        both = isinstance(actions, Continuous) and actions.low[column] < 0 < actions.high[column]
        windows = ACTION_WINDOWS if both else (NEXT_WINDOW,)
        found += [PredictionTarget(_feature_name(name, window), column, window) for window in windows]
        found += [
            PredictionTarget(_feature_name(f"|{name}|", window), column, window, size=True)
            for window in windows
            if both
        ]
    return found + [PredictionTarget(_feature_name("reward", window), columns, window) for window in REWARD_WINDOWS]


def find_subspace(
    bundle: Bundle, paths: Sequence[Path], on_progress: Callable[[int], None], views: int = 0
) -> SubspaceResult:
    """The subspace of these drives for a world model's default controllers; `on_progress` gets how many are followed.

    `views` directions of [z, h] that foretell [z, h] are features too, as many at most as foretell anything.

    `DatasetError` if they have other pictures or actions or are damaged; `UsageError` if nothing is foretold.
    """
    check_drives(paths, bundle.manifest.preprocessing)
    onlooker = FeatureExtractor(bundle)
    targets = make_targets(find_task(bundle.manifest.task).world, bundle.manifest.actions)
    halves, later = SplitSums(), SplitSums()
    for first, drives in load_in_batches(paths, bundle.manifest.actions):
        features = onlooker.features(drives, onlooker.encode_drives(drives))
        for row, drive in enumerate(drives):
            on, wanted = _mask_and_targets(drive, targets)
            seen = features[row, : len(on)]
            halves.add(first + row, LeastSquaresSums.of(seen[on], wanted[on]))
            if views and on.any():
                both = np.concatenate([seen[on], seen[np.flatnonzero(on) + VIEW_STEPS]], axis=1)
                later.add(first + row, LeastSquaresSums.of(both, np.zeros((len(both), 0))))
        on_progress(first + len(drives))
    used, others = halves.used, halves.others
    counted = [0 if each is None else each.steps for each in (used, others)]
    if used is None or others is None or sum(counted) < LEAST_STEPS or not all(counted):
        raise UsageError(
            f"{len(paths)} drives of {sum(counted)} steps that count are too few: it takes {HELD_OUT_EVERY} drives and "
            f"{LEAST_STEPS} steps; the first {FIRST_START} of a drive, its last {ACTION_WINDOWS[-1][1]} and those "
            "off the road do not count: `dreamfleet collect` drives more"
        )
    r_squared = others.r_squared(used.solve(RIDGE))
    foretold = [index for index, each in enumerate(r_squared) if each >= MIN_R_SQUARED]
    if not foretold:
        raise UsageError(f"{bundle.manifest.name} foretells nothing of these {len(paths)} drives: give others")
    whole = used + others
    solved, names = whole.solve(RIDGE)[:, foretold], [targets[each].name for each in foretold]
    told_of = [float(r_squared[each]) for each in foretold]
    if later.used and later.others:
        ahead, correlated = _canonical_features(later.used, later.others, views)
        solved, told_of = np.concatenate([solved, ahead], axis=1), told_of + correlated
        names += [
            _feature_name(f"view {number}", (VIEW_STEPS, VIEW_STEPS + 1)) for number in range(1, len(correlated) + 1)
        ]
    return SubspaceResult(_standardise(whole, solved, names, bundle), tuple(told_of), len(paths), whole.steps)


def _mask_and_targets(drive: DriveArrays, targets: Sequence[PredictionTarget]) -> tuple[NDArray[np.bool_], Doubles]:
    """The steps `(T,)` that count, and what is to be foretold at each `(T, targets)`."""
    columns = np.concatenate([drive.action, drive.reward[:, None]], axis=1).astype(np.float64)
    sums = np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(columns, axis=0)])
    on = on_road_mask(drive.reward)
    on[:FIRST_START] = False
    on[max(len(on) - ACTION_WINDOWS[-1][1], 0) :] = False
    return on, np.stack([each.values(sums) for each in targets], axis=1)


def _canonical_features(used: LeastSquaresSums, others: LeastSquaresSums, count: int) -> tuple[Doubles, list[float]]:
    """The maps `(inputs + 1, found)` to what of [z, h] is best foretold, and its share R² on other drives.

    The sums are of [z, h] now and later, side by side. As many as are foretold, `count` at most.
    """
    spread, shared, later = _covariances(used)
    whitened = [_whitening(each) for each in (spread, later)]
    left, _, right = np.linalg.svd(whitened[0] @ shared @ whitened[1])
    now, then = whitened[0] @ left[:, :count], whitened[1] @ right[:count].T
    spread, shared, later = _covariances(others)
    sizes = (now * (spread @ now)).sum(axis=0) * (then * (later @ then)).sum(axis=0)
    correlated = (now * (shared @ then)).sum(axis=0) ** 2 / sizes
    kept = correlated >= MIN_R_SQUARED
    signs = np.sign(now[np.abs(now).argmax(axis=0), np.arange(now.shape[1])])  # of a pair either will do
    solved = np.concatenate([now * signs, np.zeros((1, now.shape[1]))])[:, kept]
    return solved, [float(each) for each in correlated[kept]]


def _covariances(sums: LeastSquaresSums) -> tuple[Doubles, Doubles, Doubles]:
    """Of the first half of the inputs, of that with the second, and of the second."""
    mean, half = sums.inputs[-1, :-1] / sums.steps, len(sums.inputs) // 2
    whole = sums.inputs[:-1, :-1] / sums.steps - np.outer(mean, mean)
    return whole[:half, :half], whole[:half, half:], whole[half:, half:]


def _whitening(spread: Doubles) -> Doubles:
    """The symmetric map that gives inputs of this covariance unit variance, but for the ridge."""
    scales, axes = np.linalg.eigh(spread + RIDGE * np.eye(len(spread)))
    found: Doubles = axes / np.sqrt(scales) @ axes.T
    return found


def _standardise(sums: LeastSquaresSums, solved: Doubles, names: Sequence[str], bundle: Bundle) -> Subspace:
    """The foretold values with mean 0 and deviation 1 on these steps."""
    mean = sums.inputs[-1] @ solved / sums.steps
    squares = (solved * (sums.inputs @ solved)).sum(axis=0) / sums.steps
    deviation = np.sqrt(squares - mean**2)
    weights, offsets = solved[:-1] / deviation, (solved[-1] - mean) / deviation
    return Subspace(weights.T.astype(np.float32), offsets.astype(np.float32), tuple(names), bundle.sha256)


def _feature_name(name: str, window: tuple[int, int]) -> str:
    return f"{name} {window[0]}-{window[1]}"
