"""Probes: regressions from a world model's state to true quantities, and how much they explain on unseen drives.

They are linear or by a small network, in NumPy alone: inspection needs no torch.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.runs.standard_error import format_with_error, standard_error
from dreamfleet.worker.addons.inspection.disturbed_rollouts import OFF, DisturbedDrive

Floats = NDArray[np.float64]
Table = tuple[Sequence[Mapping[str, object]], str]  # rows, and what describes them
STRENGTH = 1e-3  # of the ridge penalty, per sample, on features of variance 1
UNITS, UPDATES, BATCH, RATE, DECAY = 64, 2000, 256, 2e-3, 1e-2  # of the network
MOMENTS, SMALL = (0.9, 0.999), 1e-8  # Adam's (Kingma & Ba 2015)


class Probe(Protocol):
    """A map from features `(N, features)` to quantities `(N, quantities)`."""

    def predict(self, features: Any) -> Floats:
        """Predict the quantities."""


@dataclass(frozen=True)
class Scale:
    """Standardises columns to mean 0 and deviation 1, and back; a constant column becomes 0."""

    mean: Floats
    deviation: Floats

    @classmethod
    def of(cls, values: Any, weights: Floats | None = None) -> Self:
        """Compute the scale of `values` `(N, columns)` with `weights` `(N,)`."""
        mean = np.average(values, axis=0, weights=weights)
        deviation = np.sqrt(np.average((values - mean) ** 2, axis=0, weights=weights))
        return cls(np.asarray(mean, float), np.asarray(np.where(deviation > 1e-9, deviation, 1.0), float))

    def apply(self, values: Any) -> Floats:
        """Standardise values."""
        return np.asarray((values - self.mean) / self.deviation)

    def undo(self, values: Any) -> Floats:
        """Map standardised values back."""
        return np.asarray(values * self.deviation + self.mean)


@dataclass(frozen=True)
class LinearProbe:
    """Ridge regression on standardised features, solved in closed form."""

    inputs: Scale
    outputs: Scale
    weights: Floats

    @classmethod
    def fit(cls, features: Any, targets: Any, weights: Floats | None = None) -> Self:
        """Fit `features` (N, features) to `targets` (N, quantities) with sample `weights` (N,)."""
        inputs, outputs = Scale.of(features, weights), Scale.of(targets, weights)
        x, y = inputs.apply(features), outputs.apply(targets)
        weighted = x if weights is None else x * weights[:, None]
        total = len(x) if weights is None else weights.sum()
        ridge = STRENGTH * total * np.eye(x.shape[1])
        found = np.linalg.solve(weighted.T @ x + ridge, weighted.T @ y)
        return cls(inputs, outputs, np.asarray(found, float))

    def predict(self, features: Any) -> Floats:
        """Predict the quantities."""
        return self.outputs.undo(self.inputs.apply(features) @ self.weights)


@dataclass(frozen=True)
class NetworkProbe:
    """One layer of tanh units on standardised features, trained by Adam on the squared error with a cosine schedule."""

    inputs: Scale
    outputs: Scale
    layers: tuple[Floats, ...]  # weights and biases of the layer, then of the output

    @classmethod
    def fit(cls, features: Any, targets: Any, seed: int = 0) -> Self:
        """Fit a network; the same data and seed give the same network."""
        inputs, outputs = Scale.of(features), Scale.of(targets)
        x, y = (each.astype(np.float32) for each in (inputs.apply(features), outputs.apply(targets)))
        random = np.random.default_rng(seed)
        layers = _initial_layers(x.shape[1], y.shape[1], random)
        moments = [(np.zeros_like(each), np.zeros_like(each)) for each in layers]
        for update in range(UPDATES):
            rows = random.integers(len(x), size=BATCH)
            rate = RATE * (1 + np.cos(np.pi * update / UPDATES)) / 2
            _adam_step(layers, moments, _gradients(layers, x[rows], y[rows]), rate, update + 1)
        return cls(inputs, outputs, tuple(layers))

    def predict(self, features: Any) -> Floats:
        """Predict the quantities."""
        first, offsets, second, last = self.layers
        hidden = np.tanh(self.inputs.apply(features) @ first + offsets)
        return self.outputs.undo(hidden @ second + last)


def _initial_layers(features: int, quantities: int, random: np.random.Generator) -> list[Any]:
    first = random.standard_normal((features, UNITS)) / np.sqrt(features)
    second = random.standard_normal((UNITS, quantities)) / np.sqrt(UNITS)
    layers = (first, np.zeros(UNITS), second, np.zeros(quantities))
    return [each.astype(np.float32) for each in layers]


def _gradients(layers: Sequence[Any], x: Any, y: Any) -> tuple[Any, ...]:
    """Gradients of half the mean squared error plus the weight decay."""
    first, offsets, second, last = layers
    hidden = np.tanh(x @ first + offsets)
    error = (hidden @ second + last - y) / len(x)
    back = (error @ second.T) * (1 - hidden**2)
    return x.T @ back + DECAY * first, back.sum(axis=0), hidden.T @ error + DECAY * second, error.sum(axis=0)


def _adam_step(
    layers: Sequence[Any], moments: Sequence[Any], gradients: Sequence[Any], rate: float, update: int
) -> None:
    for layer, (mean, square), gradient in zip(layers, moments, gradients, strict=True):
        mean[...] += (1 - MOMENTS[0]) * (gradient - mean)
        square[...] += (1 - MOMENTS[1]) * (gradient**2 - square)
        size = np.sqrt(square / (1 - MOMENTS[1] ** update)) + SMALL
        layer[...] -= rate * mean / (1 - MOMENTS[0] ** update) / size


def folds(drives: int, most: int = 4) -> Iterator[tuple[list[int], list[int]]]:
    """Yield the drives' rows in each cross-validation fold, and all other rows, on which its probe is fitted."""
    parts = min(most, drives)
    for part in range(parts):
        fold = range(part, drives, parts)
        yield list(fold), [row for row in range(drives) if row not in fold]


@dataclass(frozen=True)
class Estimate:
    """A value and its standard error."""

    value: float
    error: float | None  # `None` for the mean of one value

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """The mean of values and its standard error."""
        return cls(float(np.mean(values)), standard_error([float(each) for each in values]))

    def __str__(self) -> str:
        return format_with_error(self.value, self.error, 2)


Fit = Callable[[Floats, Floats], Probe]
PROBES: tuple[tuple[str, Fit], ...] = (("linear", LinearProbe.fit), ("network", NetworkProbe.fit))
HELD = {"z": "z", "zh": "[z, h]"}
COLUMNS = {f"{inputs}_{kind}": f"{text}, {kind}" for inputs, text in HELD.items() for kind, _ in PROBES}


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

    def table(self) -> Table:
        """As rows, and a text that describes them."""
        rows = [
            {"quantity": each.quantity, "deviation": f"{each.deviation:.3g}"}
            | {COLUMNS[name]: str(share) for name, share in each.found.items()}
            for each in self.known
        ]
        return rows, (
            f"R² ± standard error on held-out drives; {plural(self.drives, 'drive')}, {plural(self.steps, 'step')}, "
            "none off a road; deviations in the units of the world's true state (docs/reference/tasks.md)"
        )


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
    for fold, rest in folds(len(features)):
        probe = fit(np.concatenate([features[row] for row in rest]), np.concatenate([truths[row] for row in rest]))
        predicted |= {row: probe.predict(features[row]) for row in fold}
    return [predicted[row] for row in range(len(features))]


def _on_road(drive: DisturbedDrive, opening: int) -> NDArray[np.bool_]:
    kept = np.arange(len(drive)) >= opening
    return kept & (drive.truth[OFF] == 0) if OFF in drive.truth else kept
