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

from dreamfleet.common.actions import Continuous
from dreamfleet.common.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.subspace import Subspace
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.training.moments import FIRST, on_the_way
from dreamfleet.worker.training.refit import HELD_OUT, Drive, Halves, Onlooker, Sums, check_drives, followed

RIDGE = 0.001  # against the mean square of a feature; see `refit`
WINDOWS = ((0, 3), (3, 8), (8, 15), (15, 22), (22, 30), (30, 40))  # steps from now on, in which an action is asked for
NEXT = (0, 5)
EARNED = ((0, 6), (6, 20), (20, 40))  # and the reward
LEAST_STEPS = 500  # that count, of all drives: a model sees hundreds of numbers
LEAST = 0.05  # R² on held-out drives of what counts as foretold
LATER = 15  # steps until [z, h] is asked for again

Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """The subspace, R² of each of its features on held-out drives; of how many drives and steps."""

    subspace: Subspace
    r_squared: tuple[float, ...]
    drives: int
    steps: int


@dataclass(frozen=True)
class Target:
    """One thing to foretell: the mean of a column over a window of steps, or its size."""

    name: str
    column: int  # of actions; behind them the reward
    window: tuple[int, int]
    size: bool = False

    def of(self, sums: Doubles) -> Doubles:
        """At each step `(T,)` of a drive, by the running sums of its columns `(T + 1, columns)`; cut at its end."""
        steps = len(sums) - 1
        start, end = (np.minimum(np.arange(steps) + each, steps) for each in self.window)
        mean: Doubles = (sums[end, self.column] - sums[start, self.column]) / (self.window[1] - self.window[0])
        return np.abs(mean) if self.size else mean


def targets_of(world: World, columns: int) -> list[Target]:
    """What is asked for of so many actions: all windows of one that goes both ways, of others what comes next."""
    actions, found = world.actions, []
    for column in range(columns):
        name = world.action_names[column] if column < len(world.action_names) else f"action {column + 1}"
        both = isinstance(actions, Continuous) and actions.low[column] < 0 < actions.high[column]
        windows = WINDOWS if both else (NEXT,)
        found += [Target(_spoken(name, window), column, window) for window in windows]
        found += [Target(_spoken(f"|{name}|", window), column, window, size=True) for window in windows if both]
    return found + [Target(_spoken("reward", window), columns, window) for window in EARNED]


def find_subspace(bundle: Bundle, paths: Sequence[Path], told: Callable[[int], None], views: int = 0) -> Found:
    """The subspace of these drives for the default controllers of a world model; `told` hears how many are followed.

    `views` directions of [z, h] that foretell [z, h] are features too, as many at most as foretell anything.

    `DatasetError` if they have other pictures or actions or are damaged; `UsageError` if nothing is foretold.
    """
    check_drives(paths, bundle.manifest.preprocessing)
    onlooker = Onlooker(bundle)
    targets = targets_of(find_task(bundle.manifest.task).world, bundle.manifest.actions)
    halves, later = Halves(), Halves()
    for first, drives in followed(paths, bundle.manifest.actions):
        features = onlooker.features(drives, onlooker.see(drives))
        for row, drive in enumerate(drives):
            on, wanted = _asked(drive, targets)
            seen = features[row, : len(on)]
            halves.add(first + row, Sums.of(seen[on], wanted[on]))
            if views and on.any():
                both = np.concatenate([seen[on], seen[np.flatnonzero(on) + LATER]], axis=1)
                later.add(first + row, Sums.of(both, np.zeros((len(both), 0))))
        told(first + len(drives))
    used, others = halves.used, halves.others
    counted = [0 if each is None else each.steps for each in (used, others)]
    if used is None or others is None or sum(counted) < LEAST_STEPS or not all(counted):
        raise UsageError(
            f"{len(paths)} drives of {sum(counted)} steps that count are too few: it takes {HELD_OUT} drives and "
            f"{LEAST_STEPS} steps; the first {FIRST} of a drive, its last {WINDOWS[-1][1]} and those off the road "
            "do not count: `dreamfleet collect` drives more"
        )
    r_squared = others.r_squared(used.solve(RIDGE))
    foretold = [index for index, each in enumerate(r_squared) if each >= LEAST]
    if not foretold:
        raise UsageError(f"{bundle.manifest.name} foretells nothing of these {len(paths)} drives: give others")
    whole = used + others
    solved, names = whole.solve(RIDGE)[:, foretold], [targets[each].name for each in foretold]
    told_of = [float(r_squared[each]) for each in foretold]
    if later.used and later.others:
        ahead, correlated = _ahead(later.used, later.others, views)
        solved, told_of = np.concatenate([solved, ahead], axis=1), told_of + correlated
        names += [_spoken(f"view {number}", (LATER, LATER + 1)) for number in range(1, len(correlated) + 1)]
    return Found(_standardised(whole, solved, names, bundle), tuple(told_of), len(paths), whole.steps)


def _asked(drive: Drive, targets: Sequence[Target]) -> tuple[NDArray[np.bool_], Doubles]:
    """The steps `(T,)` that count, and what is to be foretold at each `(T, targets)`."""
    columns = np.concatenate([drive.action, drive.reward[:, None]], axis=1).astype(np.float64)
    sums = np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(columns, axis=0)])
    on = on_the_way(drive.reward)
    on[:FIRST] = False
    on[max(len(on) - WINDOWS[-1][1], 0) :] = False
    return on, np.stack([each.of(sums) for each in targets], axis=1)


def _ahead(used: Sums, others: Sums, count: int) -> tuple[Doubles, list[float]]:
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
    kept = correlated >= LEAST
    signs = np.sign(now[np.abs(now).argmax(axis=0), np.arange(now.shape[1])])  # of a pair either will do
    solved = np.concatenate([now * signs, np.zeros((1, now.shape[1]))])[:, kept]
    return solved, [float(each) for each in correlated[kept]]


def _covariances(sums: Sums) -> tuple[Doubles, Doubles, Doubles]:
    """Of the first half of the inputs, of that with the second, and of the second."""
    mean, half = sums.inputs[-1, :-1] / sums.steps, len(sums.inputs) // 2
    whole = sums.inputs[:-1, :-1] / sums.steps - np.outer(mean, mean)
    return whole[:half, :half], whole[:half, half:], whole[half:, half:]


def _whitening(spread: Doubles) -> Doubles:
    """The symmetric map that gives inputs of this covariance unit variance, but for the ridge."""
    scales, axes = np.linalg.eigh(spread + RIDGE * np.eye(len(spread)))
    found: Doubles = axes / np.sqrt(scales) @ axes.T
    return found


def _standardised(sums: Sums, solved: Doubles, names: Sequence[str], bundle: Bundle) -> Subspace:
    """The foretold values with mean 0 and deviation 1 on these steps."""
    mean = sums.inputs[-1] @ solved / sums.steps
    squares = (solved * (sums.inputs @ solved)).sum(axis=0) / sums.steps
    deviation = np.sqrt(squares - mean**2)
    weights, offsets = solved[:-1] / deviation, (solved[-1] - mean) / deviation
    return Subspace(weights.T.astype(np.float32), offsets.astype(np.float32), tuple(names), bundle.sha256)


def _spoken(name: str, window: tuple[int, int]) -> str:
    return f"{name} {window[0]}-{window[1]}"
