"""The curves of a page: the losses of trainings, read from their data folders, and the fitness of a run."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from dreamfleet.common.addons.analysis.fitness_chart import PLOT_COLOURS, draw_fitness, has_score_panel
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.regular_files import read_text
from dreamfleet.common.printable import plural
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import begun_stages, join_distinct
from dreamfleet.worker.addons.inspection.page import FONT, Section, new_figure, render_png

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
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
MARKED = 25  # approximate number of markers on a line
Styles = tuple[dict[str, Any], dict[str, Any]]


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


def curve_styles(trained: str, held_out: str, marker: str = "o", alpha: float = 1.0) -> Styles:
    """The line styles of training batches and of held-out drives, of two colours."""
    held = {"color": held_out, "linewidth": 1.6, "marker": marker, "markersize": 4}
    return {"color": trained, "linewidth": 1.2, "alpha": alpha}, held


ALONE, ANY = curve_styles("tab:blue", "tab:orange"), curve_styles("tab:gray", "tab:gray", "", 0.5)


def loss_sections(found: Sequence[TrainingCurves]) -> list[Section]:
    """Return a section for each trained model."""
    names = dict.fromkeys(each.name for each in found)
    looks = {name: curve_styles(colour, colour, marker, 0.5)
             for name, colour, marker in zip(names, cycle(PLOT_COLOURS), cycle(MARKERS), strict=False)}  # fmt: skip
    models = [model for model in MODELS if any(each.model == model for each in found)]
    return [_loss_section([each for each in found if each.model == model], model, looks) for model in models]


def _loss_section(found: Sequence[TrainingCurves], model: str, looks: Mapping[str, Styles]) -> Section:
    parts = [part for part in UNITS if any(part in each.curves for each in found)]
    figure, axes = new_figure(3.6 if len(found) == 1 else 4.0, 1, len(parts))
    for panel, part in zip(axes[0], parts, strict=True):
        curves = [(each.curves[part], looks[each.name]) for each in found if part in each.curves]
        for curve, look in curves:
            _draw(panel, curve, ALONE if len(found) == 1 else look)
        panel.set_title(UNITS[part][0], fontsize=FONT + 1)
        panel.set_xlabel("update", fontsize=FONT)
        panel.set_ylabel(UNITS[part][1], fontsize=FONT)
        _scale(panel, [line.values for curve, _ in curves for line in (curve.trained, curve.held_out)])
        panel.grid(alpha=0.3)
    handles = _legend_handles([each.name for each in found], looks)
    figure.legend(handles=handles, fontsize=FONT, loc="outside upper center", ncols=min(len(handles), 4))
    text = (
        "What batches lost, as a running mean, and what held-out drives did: where both still fall, more updates would "
        "help; where only the batches' falls, more drives would. Factors of a loss are not in it."
    )
    return Section(f"loss-{model}", f"How {MODELS[model]} learnt", text, render_png(figure))


def _draw(panel: Any, curve: LossCurve, look: Styles) -> None:
    trained, held, (thin, thick) = curve.trained, curve.held_out, look
    if look is ALONE:
        panel.plot(trained.updates, trained.values, **{**thin, "alpha": 0.3, "linewidth": 0.8})
    if len(trained):
        mean = np.ones(width := max(1, len(trained) // 20)) / width
        panel.plot(*(np.convolve(each, mean, mode="valid") for each in (trained.updates, trained.values)), **thin)
    panel.plot(held.updates, held.values, markevery=max(1, len(held) // MARKED), **thick)


def _legend_handles(names: Sequence[str], looks: Mapping[str, Styles]) -> list[Line2D]:
    """Legend handles of the two kinds of lines, and of each training if there are several."""
    (trained, held_out), whose = (ALONE, f"{names[0]}: ") if len(names) == 1 else (ANY, "")
    labelled = [(name, looks[name][1]) for name in names] if len(names) > 1 else []
    labelled += [(f"{whose}batches", trained), ("held-out drives", held_out)]
    return [Line2D([], [], label=label, **style) for label, style in labelled]


def _scale(panel: Any, lines: Sequence[NDArray[np.float64]]) -> None:
    values = np.concatenate(lines)
    if values.min() > 0 and values.max() > 10 * values.min():
        panel.set_yscale("log")
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.yaxis.set_minor_formatter(NullFormatter())
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panel.set_ylabel(f"{panel.get_ylabel()}, logarithmic", fontsize=FONT)


def fitness_section(run: RunFolder) -> Section | None:
    """Draw the population's fitness over a run's generations; `None` before the first one is complete."""
    history = run.history()
    if not history:
        return None
    two = has_score_panel(run)
    figure, axes = new_figure(5.6 if two else 4, 2 if two else 1, sharex=True)
    handles = draw_fitness(list(axes[:, 0]), run)
    figure.legend(handles=handles, fontsize=FONT, loc="outside lower left", ncols=2, frameon=False)
    axes[0, 0].set_ylabel("fitness")
    if two:
        axes[1, 0].set_ylabel("score in reality")
    horizon = join_distinct(
        str(each.stage.settings.task.horizon) for each in begun_stages(run.settings, history, run.evaluations())
    )
    text = f"Run {run.name}, task {run.spec.task}, {horizon} steps an episode: fitness over the generations."
    return Section("fitness", "How its controller evolved", text, render_png(figure))
