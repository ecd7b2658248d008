"""Compare how often large values of each true quantity occur in dreams and in reality.

A dream may be plausible from step to step and yet contain fewer or milder bends than the world, and controllers evolve
for what it contains. A linear probe estimates each quantity from [z, h]. It is fitted on other drives, on latents
predicted one step ahead, and is also applied to real steps, so that its own errors show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.inspection.disturbed_rollouts import OFF, DisturbedDrive
from dreamfleet.worker.addons.inspection.drive_dreams import DreamSegment, DriveDreamer
from dreamfleet.worker.addons.inspection.probe import Estimate, LinearProbe, folds, other_rows
from dreamfleet.worker.addons.inspection.road_losses import FOLDS

Floats = NDArray[np.float64]
RARE = 0.9  # quantile of a quantity's absolute value in reality above which it counts as rare
SHORTEST = 100  # steps on the road that a drive must have


@dataclass(frozen=True)
class RareFrequency:
    """One quantity: the absolute value that a tenth of real steps exceeds, and the shares of steps that exceed it.

    The shares are by source: `reality` by the true state, `foreseen` by the probe on real steps predicted one step
    ahead, `dream` by the probe on dreamt steps.
    """

    quantity: str
    rare: float
    found: dict[str, Estimate]


@dataclass(frozen=True)
class LikenessReport:
    """Each quantity's shares, and of how many drives, dreams of each, and dreams of which temperature they are."""

    drives: int
    dreams: int
    temperature: float
    quantities: tuple[RareFrequency, ...]


def compare_frequencies(
    drives: Sequence[DisturbedDrive], bundle: Bundle, controller: Controller, opening: int, dreams: int,
    temperature: float,
) -> LikenessReport:  # fmt: skip
    """Compare each drive, from its opening until it leaves the road, with dreams of the same length and disturbance.

    `UsageError` if fewer than two drives stay on the road for long enough.
    """
    begun = [each for drive in drives if (each := _dream_segment(drive, opening)) is not None]
    if len(begun) < 2:
        raise UsageError(f"dreams are compared with two drives at least that stay on the road for {SHORTEST} steps")
    dreamer = DriveDreamer(bundle, controller, temperature, dreams)
    if begun[0].drive.truth.keys() <= {OFF}:
        raise UsageError("the world's true state has no quantity to compare dreams with")
    names = [name for name in begun[0].drive.truth if name != OFF]
    truths = [np.stack([each.drive.truth[name][each.steps] for name in names], axis=1) for each in begun]
    foreseen = [dreamer.predict_next(each.drive)[0][each.steps] for each in begun]
    rare = np.quantile(np.abs(np.concatenate(truths)), RARE, axis=0)
    shares: list[dict[str, Floats]] = []
    for fold in folds(len(begun), most=FOLDS):
        rest = other_rows(fold, len(begun))
        probe = LinearProbe.fit(*(np.concatenate([each[row] for row in rest]) for each in (foreseen, truths)))
        for row in fold:
            dreamt = _before_ends(dreamer.dream(begun[row], own=True)[0])
            if not len(dreamt):
                continue
            by_source = {
                "reality": truths[row],
                "foreseen": probe.predict(foreseen[row]),
                "dream": probe.predict(dreamt),
            }
            shares.append({where: (np.abs(values) > rare).mean(axis=0) for where, values in by_source.items()})
    if len(shares) < 2:
        raise UsageError("the dreams of all drives but one end as they begin: nothing can be measured on them")
    found = {where: np.stack([each[where] for each in shares], axis=1) for where in shares[0]}
    quantities = tuple(
        RareFrequency(name, float(rare[row]), {where: Estimate.of(list(each[row])) for where, each in found.items()})
        for row, name in enumerate(names)
    )
    return LikenessReport(len(drives), dreams, temperature, quantities)


def _before_ends(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """The steps `(steps, features)` of dreams `(dreams, steps, features)` before their ends.

    After its end a dream repeats its last state.
    """
    still = (np.diff(features, axis=1) == 0).all(axis=2)
    going: NDArray[np.float32] = features[:, 1:][~still]
    return going


def _dream_segment(drive: DisturbedDrive, opening: int) -> DreamSegment | None:
    """The part of a drive from its opening until it first leaves the road; `None` if that is too short."""
    off = np.flatnonzero(drive.truth.get(OFF, np.zeros(len(drive)))[opening:] > 0)
    length = int(off[0]) if len(off) else len(drive) - opening
    return DreamSegment(drive, opening, length) if length >= SHORTEST else None
