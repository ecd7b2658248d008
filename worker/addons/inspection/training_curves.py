"""Load the loss curves of trainings from their data folders."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.regular_files import read_text
from dreamfleet.common.printable import plural

Doubles = NDArray[np.float64]
Points = list[dict[str, float]]
MOST_BYTES, MOST = 100_000_000, 1e30  # largest file of points, largest loss
HELD_OUT, WHOLE = "held_out_", "held_out"
MODELS = {"vae": "the VAE", "mdnrnn": "the MDN-RNN"}
UNITS = {  # of each part of a loss, by its name in the curve: title and unit
    "error": ("reconstruction error", "squared error a picture"),
    "kl": ("divergence", "nats a picture"),
    "latent": ("next latents", "nats a latent dimension"),
    "reward": ("reward head", "nats a step (squares, if of values)"),
    "done": ("head of the end", "nats a step"),
}


@dataclass(frozen=True)
class LossLine:
    """Losses at updates `(points,)`."""

    updates: Doubles
    values: Doubles

    def __len__(self) -> int:
        return len(self.updates)


@dataclass(frozen=True)
class LossCurve:
    """One part of a loss, on training batches and on held-out drives."""

    trained: LossLine
    held_out: LossLine


@dataclass(frozen=True)
class TrainingCurves:
    """A model's training of `updates` updates: a curve for each part of its loss, by name.

    `best` is the update with the smallest total loss on held-out drives.
    """

    name: str
    model: str
    updates: float
    curves: Mapping[str, LossCurve]
    best: float | None

    @property
    def summary(self) -> str:
        """The number of updates, and the held-out losses at the best one."""
        if self.best is None:
            return f"{plural(round(self.updates), 'update')}"
        parts = [
            f"{UNITS[part][0]} {loss:.4g}"
            for part, curve in self.curves.items()
            for loss in curve.held_out.values[curve.held_out.updates == self.best]
        ]
        return (
            f"{plural(round(self.updates), 'update')}; held-out drives lost least in all at "
            f"{self.best:,.0f}: {', '.join(parts)}"
        )


def load_trainings(folders: Sequence[Path]) -> list[TrainingCurves]:
    """Load the trainings in data folders; `DatasetError` names a folder without any."""
    return [each for folder, name in zip(folders, _names(folders), strict=True) for each in _load_folder(folder, name)]


def _load_folder(folder: Path, name: str) -> list[TrainingCurves]:
    if not folder.is_dir():
        raise DatasetError(
            f"no folder {folder}: --data names folders of trainings; a bundle or run to inspect goes before it"
        )
    paths = {model: folder / f"{model}.jsonl" for model in MODELS}
    found = [_load_training(path, name, model) for model, path in paths.items() if path.exists()]
    if not found:
        raise DatasetError(f"{folder} holds no loss curve: give --data the folder of a training, or omit it")
    return found


def _names(folders: Sequence[Path]) -> list[str]:
    """The folders' names, or their paths if two names are equal."""
    names = [folder.resolve().name for folder in folders]
    return names if len(set(names)) == len(names) else [str(folder) for folder in folders]


def _load_training(path: Path, name: str, model: str) -> TrainingCurves:
    rows = merge_points(read_points(path))
    found = {part: LossCurve(_make_line(rows, part), _make_line(rows, HELD_OUT + part)) for part in UNITS}
    curves = {part: curve for part, curve in found.items() if len(curve.trained) or len(curve.held_out)}
    if not curves:
        raise DatasetError(f"{path} holds no loss curve ({', '.join(UNITS)}); move it away, or choose another --data")
    wholes = {update: whole for update, row in rows.items() if (whole := _held_out(row)) is not None}
    return TrainingCurves(name, model, max(rows), curves, min(wholes, key=wholes.__getitem__, default=None))


def _held_out(row: Mapping[str, float]) -> float | None:
    """The total held-out loss: the VAE records it, otherwise it is the sum of the parts."""
    parts = [value for name, value in row.items() if name.startswith(HELD_OUT)]
    return row.get(WHOLE, sum(parts)) if parts else None


def _make_line(rows: Mapping[float, Mapping[str, float]], name: str) -> LossLine:
    found = {update: row[name] for update, row in rows.items() if name in row}
    return LossLine(np.array(list(found), dtype=np.float64), np.array(list(found.values()), dtype=np.float64))


def read_points(path: Path) -> Points:
    """Read the points of a curve, of batches and of held-out drives; `DatasetError` if it is damaged or empty."""
    try:
        points: Points = [json.loads(line) for line in read_text(path, MOST_BYTES).splitlines() if line]
        if not points or any("update" not in point or len(point) < 2 for point in points):
            raise ValueError("a point lacks its update or a loss")
        if not all(type(each) in (int, float) and abs(each) < MOST for point in points for each in point.values()):
            raise ValueError("a point is not a finite number")
    except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise DatasetError(f"{path} holds no loss curve ({error}); move it away, or choose another --data") from error
    return points


def merge_points(points: Points) -> dict[float, dict[str, float]]:
    """Merge points by update, in order. Where a training went back to a checkpoint, new points replace later ones."""
    rows: dict[float, dict[str, float]] = {}
    for point in points:
        update, parts = point["update"], {name: value for name, value in point.items() if name != "update"}
        while rows and (
            (last := next(reversed(rows))) > update or (last == update and parts.keys() & rows[last].keys())
        ):
            del rows[last]
        rows.setdefault(update, {}).update(parts)
    return rows
