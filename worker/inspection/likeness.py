"""Whether dreams are of the world that is driven: how often they come to what is rare there.

A dream may follow from step to step and yet hold fewer bends than the world does, or milder ones; controllers evolve
for what it holds. A linear probe tells each quantity of the truth from [z, h]. It is fitted on other drives' latents as
they are foreseen one step ahead, and it also judges real drives, so that its own faults show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.inspection.disturbed_rollouts import OFF, DisturbedDrive
from dreamfleet.worker.inspection.drive_dreams import DreamSegment, DriveDreamer
from dreamfleet.worker.inspection.probe import Estimate, LinearProbe, folds, other_rows
from dreamfleet.worker.inspection.road_losses import FOLDS

Floats = NDArray[np.float64]
RARE = 0.9  # the quantile of a quantity's size in reality, beyond which it is rare
SHORTEST = 100  # steps on the road that a drive has to have


@dataclass(frozen=True)
class RareFrequency:
    """Of one quantity: the size that a tenth of real steps exceeds, and the share of steps that does.

    In `reality` by its truth, `foreseen` by the probe on real steps, `dream` by the probe on dreamt ones.
    """

    quantity: str
    rare: float
    found: dict[str, Estimate]


def compare(
    drives: Sequence[DisturbedDrive], bundle: Bundle, controller: Controller, opening: int, dreams: int,
    temperature: float,
) -> list[RareFrequency]:  # fmt: skip
    """Dreams begun behind each drive's opening, as long as it keeps to the road, under the same disturbance.

    `UsageError` if fewer than two drives keep to it for long enough.
    """
    begun = [each for drive in drives if (each := _dream_segment(drive, opening)) is not None]
    if len(begun) < 2:
        raise UsageError(f"dreams are held to two drives at least that keep to the road for {SHORTEST} steps")
    imagination = DriveDreamer(bundle, controller, temperature, dreams)
    if begun[0].drive.truth.keys() <= {OFF}:
        raise UsageError("the world's truth tells nothing that dreams could be held to")
    names = [name for name in begun[0].drive.truth if name != OFF]
    truths = [np.stack([each.drive.truth[name][each.steps] for name in names], axis=1) for each in begun]
    foreseen = [imagination.predict_next(each.drive)[0][each.steps] for each in begun]
    rare = np.quantile(np.abs(np.concatenate(truths)), RARE, axis=0)
    shares: list[dict[str, Floats]] = []
    for fold in folds(len(begun), most=FOLDS):
        rest = other_rows(fold, len(begun))
        probe = LinearProbe.fit(*(np.concatenate([each[row] for row in rest]) for each in (foreseen, truths)))
        for row in fold:
            dreamt = _before_ends(imagination.dream(begun[row], own=True)[0])
            if not len(dreamt):
                continue
            told = {"reality": truths[row], "foreseen": probe.predict(foreseen[row]), "dream": probe.predict(dreamt)}
            shares.append({where: (np.abs(values) > rare).mean(axis=0) for where, values in told.items()})
    if len(shares) < 2:
        raise UsageError("the dreams of all drives but one end as they begin: nothing of them can be told")
    found = {where: np.stack([each[where] for each in shares], axis=1) for where in shares[0]}
    return [
        RareFrequency(name, float(rare[row]), {where: Estimate.of(list(each[row])) for where, each in found.items()})
        for row, name in enumerate(names)
    ]


def _before_ends(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """The steps `(steps, features)` of dreams `(dreams, steps, features)`, without those behind their ends.

    A dream that has ended stays as it was.
    """
    still = (np.diff(features, axis=1) == 0).all(axis=2)
    going: NDArray[np.float32] = features[:, 1:][~still]
    return going


def _dream_segment(drive: DisturbedDrive, opening: int) -> DreamSegment | None:
    """The part of a drive behind its opening until it first leaves the road."""
    off = np.flatnonzero(drive.truth.get(OFF, np.zeros(len(drive)))[opening:] > 0)
    length = int(off[0]) if len(off) else len(drive) - opening
    return DreamSegment(drive, opening, length) if length >= SHORTEST else None
