"""How much of its world's true state a world model holds: R² of maps from [z, h] to each quantity on unseen drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.inspection.disturbed_rollouts import OFF, DisturbedDrive
from dreamfleet.worker.addons.inspection.probe import Estimate, LinearProbe, NetworkProbe, Probe, folds, other_rows

Floats = NDArray[np.float64]
Fit = Callable[[Floats, Floats], Probe]
PROBES: tuple[tuple[str, Fit], ...] = (("linear", LinearProbe.fit), ("network", NetworkProbe.fit))


@dataclass(frozen=True)
class KnownQuantity:
    """One quantity's R² on held-out drives, by inputs (`z`, `zh`) and kind of map, with keys such as `z_linear`."""

    quantity: str
    deviation: float  # of its true values
    found: dict[str, Estimate]


@dataclass(frozen=True)
class Knowledge:
    """R² of each quantity, and the number of drives and steps it was measured on."""

    drives: int
    steps: int
    known: tuple[KnownQuantity, ...]


def cross_validate_probes(drives: Sequence[DisturbedDrive], opening: int) -> Knowledge:
    """Cross-validate: predict each fold's drives by maps fitted on the other folds; `UsageError` for too few drives.

    Steps off the road are left out, because the quantities of the road ahead mean nothing there.
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
    """R² of each column over the rows of all drives, with a standard error by the jackknife over drives.

    It is 0 for a column that never changes.
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
    """Predict each drive's quantities by a map that was fitted without its fold."""
    predicted: dict[int, Floats] = {}
    for fold in folds(len(features)):
        rest = other_rows(fold, len(features))
        probe = fit(np.concatenate([features[row] for row in rest]), np.concatenate([truths[row] for row in rest]))
        predicted |= {row: probe.predict(features[row]) for row in fold}
    return [predicted[row] for row in range(len(features))]


def _on_road(drive: DisturbedDrive, opening: int) -> NDArray[np.bool_]:
    kept = np.arange(len(drive)) >= opening
    return kept & (drive.truth[OFF] == 0) if OFF in drive.truth else kept
