"""Fit a subspace of [z, h] for a search: the directions that predict a driver's later actions and rewards linearly.

The targets come from recorded drives: for each step the mean actions, their absolute values and the mean rewards over
windows of the following steps. They are regressed on [z, h] by ridge regression (Hoerl and Kennard 1970) in closed
form. Each target that is predictable on held-out drives gives a feature: the direction of [z, h] that predicts, say,
the steering half a second later.

Quantities that a driver corrects at once, such as the place on the road, do not show in its later actions. So the
features can also include "views": the directions of [z, h] that correlate best with [z, h] some steps later, by
canonical correlation analysis (Hotelling 1936). Pages: optimisers.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.worker.addons.refit.drive_regression import (
    HELD_OUT_EVERY,
    DriveArrays,
    FeatureExtractor,
    LeastSquaresSums,
    SplitSums,
    check_drives,
    load_in_batches,
)
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.training.data.drive_steps import FIRST_START, on_road_mask

RIDGE = 0.001  # against the mean square of a feature; see `refit`
# Steps from now, of two-sided actions such as steering.
ACTION_WINDOWS = ((0, 3), (3, 8), (8, 15), (15, 22), (22, 30), (30, 40))
NEXT_WINDOW = (0, 5)  # of other actions
REWARD_WINDOWS = ((0, 6), (6, 20), (20, 40))
LEAST_STEPS = 500  # usable steps of all drives, since [z, h] has hundreds of columns
LEAST_VARIANCE = 0.001  # of a view, after whitening: what varies less is rounding beside the ridge
MIN_R_SQUARED = 0.05  # on held-out drives, for a predictable target
VIEW_STEPS = 15  # steps ahead that a view predicts

Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class SubspaceResult:
    """The subspace, R² of each of its features on held-out drives, and how many drives and steps it was fitted on."""

    subspace: Subspace
    r_squared: tuple[float, ...]
    drives: int
    steps: int


@dataclass(frozen=True)
class PredictionTarget:
    """One target: the mean of a column over a window of steps, or its absolute value."""

    quantity: str
    column: int  # of the actions followed by the reward
    window: tuple[int, int]
    size: bool = False  # take the absolute value

    @property
    def name(self) -> str:
        """The feature's name: the quantity, and the window."""
        return f"{self.quantity} {self.window[0]}-{self.window[1]}"

    def values(self, sums: Doubles) -> Doubles:
        """Its values at each step `(T,)` of a drive, from the columns' running sums `(T + 1, columns)`.

        Windows are cut at the drive's end.
        """
        steps = len(sums) - 1
        start, end = (np.minimum(np.arange(steps) + each, steps) for each in self.window)
        mean: Doubles = (sums[end, self.column] - sums[start, self.column]) / (self.window[1] - self.window[0])
        return np.abs(mean) if self.size else mean


def make_targets(world: World, columns: int) -> list[PredictionTarget]:
    """Make the targets: all windows of a two-sided action, and the next steps of others, and the rewards."""
    actions, found = world.actions, []
    for column in range(columns):
        name = world.action_names[column] if column < len(world.action_names) else f"action {column + 1}"
        both = (
            isinstance(actions, Continuous) and not actions.choices and actions.low[column] < 0 < actions.high[column]
        )
        windows = ACTION_WINDOWS if both else (NEXT_WINDOW,)
        found += [PredictionTarget(name, column, window) for window in windows]
        found += [PredictionTarget(f"|{name}|", column, window, size=True) for window in windows if both]
    return found + [PredictionTarget("reward", columns, window) for window in REWARD_WINDOWS]


def find_subspace(
    bundle: Bundle, paths: Sequence[Path], on_progress: Callable[[int], None], views: int = 0
) -> SubspaceResult:
    """Fit the subspace for a world model's default controllers; `on_progress` gets the number of drives processed.

    It has at most `views` views besides the predicted targets.

    `DatasetError` for damaged drives or other pictures or actions; `UsageError` if no target is predictable.
    """
    check_drives(paths, bundle)
    extractor = FeatureExtractor(bundle)
    world = task_of(bundle).world
    targets = make_targets(world, bundle.manifest.actions)
    split, later = SplitSums(), SplitSums()
    for first, drives in load_in_batches(paths, bundle.manifest.actions):
        features = extractor.features(drives, extractor.encode_drives(drives))
        for row, drive in enumerate(drives):
            on, wanted = _mask_and_targets(drive, targets, world.lost_after)
            seen = features[row, : len(on)]
            split.add(first + row, LeastSquaresSums.of(seen[on], wanted[on]))
            if views and on.any():
                both = np.concatenate([seen[on], seen[np.flatnonzero(on) + VIEW_STEPS]], axis=1)
                later.add(first + row, LeastSquaresSums.of(both, np.zeros((len(both), 0))))
        on_progress(first + len(drives))
    fit, held_out = split.fit, split.held_out
    counted = fit.steps, held_out.steps
    if sum(counted) < LEAST_STEPS or not all(counted):
        raise UsageError(
            f"{plural(len(paths), 'drive')} of {sum(counted)} counted steps are too few: it takes {HELD_OUT_EVERY} "
            f"drives and {LEAST_STEPS} steps; `dreamfleet collect` drives more. Not counted are the first "
            f"{FIRST_START} steps of a drive, its last {ACTION_WINDOWS[-1][1]} and those off the road"
        )
    r_squared = held_out.r_squared(fit.solve(RIDGE))
    predictable = [index for index, each in enumerate(r_squared) if each >= MIN_R_SQUARED]
    if not predictable:
        raise UsageError(f"{bundle.manifest.name} predicts nothing of these {plural(len(paths), 'drive')}: give others")
    whole = fit + held_out
    solved, names = whole.solve(RIDGE)[:, predictable], [targets[each].name for each in predictable]
    scores = [float(r_squared[each]) for each in predictable]
    if later.fit.steps and later.held_out.steps:
        ahead, correlated = _canonical_features(later.fit, later.held_out, views)
        solved, scores = np.concatenate([solved, ahead], axis=1), scores + correlated
        names += [f"view {number} {VIEW_STEPS}-{VIEW_STEPS + 1}" for number in range(1, len(correlated) + 1)]
    return SubspaceResult(_standardise(whole, solved, names, bundle), tuple(scores), len(paths), whole.steps)


def _mask_and_targets(
    drive: DriveArrays, targets: Sequence[PredictionTarget], lost_after: int
) -> tuple[NDArray[np.bool_], Doubles]:
    """The mask `(T,)` of usable steps, and the targets' values `(T, targets)`."""
    columns = np.concatenate([drive.action, drive.reward[:, None]], axis=1).astype(np.float64)
    sums = np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(columns, axis=0)])
    on = on_road_mask(drive.reward, lost_after)
    on[:FIRST_START] = False
    on[max(len(on) - ACTION_WINDOWS[-1][1], 0) :] = False
    return on, np.stack([each.values(sums) for each in targets], axis=1)


def _canonical_features(fit: LeastSquaresSums, held_out: LeastSquaresSums, count: int) -> tuple[Doubles, list[float]]:
    """The maps `(inputs + 1, found)` of at most `count` views, and their R² on held-out drives.

    The sums are over [z, h] now and later, side by side.
    """
    spread, shared, later = _covariances(fit)
    whitened = [_whitening(each) for each in (spread, later)]
    left, _, right = np.linalg.svd(whitened[0] @ shared @ whitened[1])
    now, then = whitened[0] @ left[:, :count], whitened[1] @ right[:count].T
    spread, shared, later = _covariances(held_out)
    variances = [(now * (spread @ now)).sum(axis=0), (then * (later @ then)).sum(axis=0)]
    varies = np.minimum(*variances) >= LEAST_VARIANCE
    products = np.where(varies, variances[0] * variances[1], np.inf)
    correlated = (now * (shared @ then)).sum(axis=0) ** 2 / products
    kept = correlated >= MIN_R_SQUARED
    signs = np.sign(now[np.abs(now).argmax(axis=0), np.arange(now.shape[1])])  # an arbitrary sign, fixed here
    solved = np.concatenate([now * signs, np.zeros((1, now.shape[1]))])[:, kept]
    return solved, [float(each) for each in correlated[kept]]


def _covariances(sums: LeastSquaresSums) -> tuple[Doubles, Doubles, Doubles]:
    """The covariances of the inputs' first half, between both halves, and of the second half."""
    mean, half = sums.inputs[-1, :-1] / sums.steps, len(sums.inputs) // 2
    whole = sums.inputs[:-1, :-1] / sums.steps - np.outer(mean, mean)
    return whole[:half, :half], whole[:half, half:], whole[half:, half:]


def _whitening(spread: Doubles) -> Doubles:
    """The symmetric map that whitens inputs of this covariance, apart from the ridge."""
    scales, axes = np.linalg.eigh(spread + RIDGE * np.eye(len(spread)))
    return np.asarray(axes / np.sqrt(scales) @ axes.T)


def _standardise(sums: LeastSquaresSums, solved: Doubles, names: Sequence[str], bundle: Bundle) -> Subspace:
    """Scale the predicted values to mean 0 and deviation 1 on these steps."""
    mean = sums.inputs[-1] @ solved / sums.steps
    squares = (solved * (sums.inputs @ solved)).sum(axis=0) / sums.steps
    deviation = np.sqrt(squares - mean**2)
    weights, offsets = solved[:-1] / deviation, (solved[-1] - mean) / deviation
    owner = bundle.same_models[-1]  # of a rounded bundle the whole one, so that it fits both
    return Subspace(weights.T.astype(np.float32), offsets.astype(np.float32), tuple(names), owner)
