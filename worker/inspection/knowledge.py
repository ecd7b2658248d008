"""What a world model knows of its world's truth: how much of each quantity a map from [z, h] finds on unseen drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.inspection.disturbed_rollouts import OFF, DisturbedDrive
from dreamfleet.worker.inspection.probe import Estimate, LinearProbe, NetworkProbe, Probe, folds, other_rows

Floats = NDArray[np.float64]
Fit = Callable[[Floats, Floats], Probe]
PROBES: tuple[tuple[str, Fit], ...] = (("linear", LinearProbe.fit), ("network", NetworkProbe.fit))


@dataclass(frozen=True)
class KnownQuantity:
    """Of one quantity: R² on held-out drives by what is seen (`z`, `zh`) and how it is mapped, as in `z_linear`."""

    quantity: str
    deviation: float  # of its true values
    found: dict[str, Estimate]


@dataclass(frozen=True)
class Knowledge:
    """What is known of each quantity, and by how many drives and steps that was measured."""

    drives: int
    steps: int
    known: tuple[KnownQuantity, ...]


def cross_validate_probes(drives: Sequence[DisturbedDrive], opening: int) -> Knowledge:
    """Hold each fold's drives against maps that were fitted on the other folds'; `UsageError` if there are too few.

    Steps on which the road is lost are left out: what the road ahead is like means nothing there.
    """
    seen = [(drive, rows) for drive in drives if (rows := _on_road(drive, opening)).any()]
    if len(seen) < 2:
        raise UsageError("a probe needs two drives on the road at least, one to fit and one to judge: raise --episodes")
    names = [name for name in drives[0].truth if name != OFF]
    truths = [np.stack([drive.truth[name][rows] for name in names], axis=1) for drive, rows in seen]
    found: dict[str, list[Estimate]] = {}
    for inputs, columns in (("z", drives[0].latent.shape[1]), ("zh", None)):
        features = [drive.features[rows, :columns].astype(np.float64) for drive, rows in seen]
        for kind, fit in PROBES:
            found[f"{inputs}_{kind}"] = explained_variance(truths, _predict_held_out(features, truths, fit))
    deviations = np.concatenate(truths).std(axis=0)
    known = tuple(
        KnownQuantity(name, float(deviations[row]), {how: shares[row] for how, shares in found.items()})
        for row, name in enumerate(names)
    )
    return Knowledge(len(seen), sum(len(each) for each in truths), known)


def explained_variance(truths: Sequence[Floats], predictions: Sequence[Floats]) -> list[Estimate]:
    """R² of each column over all drives' rows; its standard error by leaving out one drive at a time (jackknife).

    Of a column that never changes nothing can be explained: 0.
    """
    mean = np.concatenate(truths).mean(axis=0)
    wrong = np.stack([((p - t) ** 2).sum(axis=0) for p, t in zip(predictions, truths, strict=True)])
    spread = np.stack([((t - mean) ** 2).sum(axis=0) for t in truths])
    whole = _explained_share(wrong.sum(axis=0), spread.sum(axis=0))
    without = _explained_share(wrong.sum(axis=0) - wrong, spread.sum(axis=0) - spread)
    error = np.sqrt((len(truths) - 1) / len(truths) * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    return [Estimate(float(value), float(each)) for value, each in zip(whole, error, strict=True)]


def _explained_share(wrong: Floats, spread: Floats) -> Floats:
    changes = spread > 1e-9
    return np.where(changes, 1 - wrong / np.where(changes, spread, 1.0), 0.0)


def _predict_held_out(features: Sequence[Floats], truths: Sequence[Floats], fit: Fit) -> list[Floats]:
    """Each drive's quantities as a map tells them that has not seen its fold."""
    told: dict[int, Floats] = {}
    for fold in folds(len(features)):
        rest = other_rows(fold, len(features))
        probe = fit(np.concatenate([features[row] for row in rest]), np.concatenate([truths[row] for row in rest]))
        told |= {row: probe.predict(features[row]) for row in fold}
    return [told[row] for row in range(len(features))]


def _on_road(drive: DisturbedDrive, opening: int) -> NDArray[np.bool_]:
    kept = np.arange(len(drive)) >= opening
    return kept & (drive.truth[OFF] == 0) if OFF in drive.truth else kept
