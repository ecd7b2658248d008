"""Trainings, as the loss curves of their data folders tell of them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.regular_files import read_text

Doubles = NDArray[np.float64]
Points = list[dict[str, float]]
MOST_BYTES, MOST = 100_000_000, 1e30  # of a file of points, and of a loss that can be drawn
HELD_OUT, WHOLE = "held_out_", "held_out"
MODELS = {"vae": "the VAE", "mdnrnn": "the MDN-RNN"}
UNITS = {  # of each part of a loss, as training names it: what it is of, and what in
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

    def at(self, update: float) -> float:
        """The loss at an update that it has."""
        return float(self.values[self.updates == update][0])


@dataclass(frozen=True)
class LossCurve:
    """A part of a loss: of the batches that were trained on, and of held-out drives."""

    trained: LossLine
    held_out: LossLine


@dataclass(frozen=True)
class TrainingCurves:
    """A model's training in a folder, `updates` long: a curve a part of its loss, by name.

    `best` is the update whose loss of held-out drives was least in all.
    """

    name: str
    model: str
    updates: float
    curves: Mapping[str, LossCurve]
    best: float | None

    @property
    def summary(self) -> str:
        """How long it was, and what held-out drives lost where they lost least."""
        if self.best is None:
            return f"{self.updates:,.0f} updates"
        held = {part: each.held_out for part, each in self.curves.items()}
        parts = [
            f"{UNITS[part][0]} {line.at(self.best):.4g}" for part, line in held.items() if self.best in line.updates
        ]
        return f"{self.updates:,.0f} updates; held-out drives lost least in all at {self.best:,.0f}: {', '.join(parts)}"


def load_trainings(folders: Sequence[Path]) -> list[TrainingCurves]:
    """The trainings in data folders; `DatasetError` names a folder that holds none."""
    return [each for folder, name in zip(folders, _names(folders), strict=True) for each in _load_folder(folder, name)]


def _load_folder(folder: Path, name: str) -> list[TrainingCurves]:
    if not folder.is_dir():
        raise DatasetError(
            f"no folder {folder}: --data names folders that were trained in, and what is looked into stands before it"
        )
    paths = {model: folder / f"{model}.jsonl" for model in MODELS}
    found = [_load_training(path, name, model) for model, path in paths.items() if path.exists()]
    if not found:
        raise DatasetError(f"{folder} holds no loss curve: give --data a folder that was trained in, or leave it out")
    return found


def _names(folders: Sequence[Path]) -> list[str]:
    """Each folder's own name; where two have one name, their paths."""
    names = [folder.resolve().name for folder in folders]
    return names if len(set(names)) == len(names) else [str(folder) for folder in folders]


def _load_training(path: Path, name: str, model: str) -> TrainingCurves:
    rows = merge_points(read_points(path))
    found = {part: LossCurve(_make_line(rows, part), _make_line(rows, HELD_OUT + part)) for part in UNITS}
    curves = {part: curve for part, curve in found.items() if list(_lines(curve))}
    if not curves:
        raise DatasetError(f"{path} holds no loss curve ({', '.join(UNITS)}); delete it, training writes it again")
    wholes = {update: whole for update, row in rows.items() if (whole := _held_out(row)) is not None}
    return TrainingCurves(name, model, max(rows), curves, min(wholes, key=wholes.__getitem__, default=None))


def _held_out(row: Mapping[str, float]) -> float | None:
    """The loss of held-out drives in all: the VAE's own, else the sum of its parts."""
    parts = [value for name, value in row.items() if name.startswith(HELD_OUT)]
    return row.get(WHOLE, sum(parts)) if parts else None


def _make_line(rows: Mapping[float, Mapping[str, float]], name: str) -> LossLine:
    found = {update: row[name] for update, row in rows.items() if name in row}
    return LossLine(np.array(list(found), dtype=np.float64), np.array(list(found.values()), dtype=np.float64))


def _lines(curve: LossCurve) -> Iterable[LossLine]:
    return (line for line in (curve.trained, curve.held_out) if len(line))


def read_points(path: Path) -> Points:
    """The points of a curve, some of batches, some of held-out drives; `DatasetError` if it is damaged or empty."""
    try:
        points: Points = [json.loads(line) for line in read_text(path, MOST_BYTES).splitlines() if line]
        if not points or any("update" not in point or len(point) < 2 for point in points):
            raise ValueError("a point tells no loss of an update")
        if not all(type(each) in (int, float) and abs(each) < MOST for point in points for each in point.values()):
            raise ValueError("a point is no finite number")
    except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise DatasetError(f"{path} holds no loss curve ({error}); delete it, training writes it again") from error
    return points


def merge_points(points: Points) -> dict[float, dict[str, float]]:
    """What each update tells, in order; a training that went back to a checkpoint tells the updates behind it anew."""
    rows: dict[float, dict[str, float]] = {}
    for point in points:
        update, parts = point["update"], {name: value for name, value in point.items() if name != "update"}
        while rows and (
            (last := next(reversed(rows))) > update or (last == update and parts.keys() & rows[last].keys())
        ):
            del rows[last]
        rows.setdefault(update, {}).update(parts)
    return rows
