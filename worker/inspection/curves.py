"""Curves on disk: the losses of training, the fitness of a run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files import read_text
from dreamfleet.common.runs import RunFolder
from dreamfleet.common.stages import begun_stages, in_turn
from dreamfleet.worker.inspection.charts import FONT, new_figure, png
from dreamfleet.worker.inspection.section import Section

Points = list[dict[str, float]]
MOST_BYTES, MOST = 100_000_000, 1e30  # of a file of points, and of a loss that can be drawn
LOSSES = (("vae", "the VAE"), ("mdnrnn", "the MDN-RNN"))


def losses(folder: Path) -> list[Section]:
    """A section for each model whose losses lie in a data folder."""
    if not folder.is_dir():
        raise DatasetError(f"no folder {folder}: give --data a folder that was trained in, or leave it out")
    named = [(f"{name}.jsonl", name, what) for name, what in LOSSES]
    return [loss(read_points(folder / file), name, what) for file, name, what in named if (folder / file).exists()]


def loss(points: Points, name: str, what: str) -> Section:
    """Each part of a loss over the updates."""
    names = [each for each in points[0] if each != "update"]
    figure, axes = new_figure(2.8, 1, len(names))
    updates = [point["update"] for point in points]
    for panel, each in zip(axes[0], names, strict=True):
        values = np.array([point[each] for point in points])
        panel.plot(updates, values, color="tab:blue", alpha=0.35, linewidth=0.8)
        width = max(1, len(values) // 50)
        smooth = np.convolve(values, np.ones(width) / width, mode="valid")
        panel.plot(updates[width - 1 :], smooth, color="tab:blue")
        panel.set_title(each, fontsize=FONT + 1)
        panel.set_xlabel("update", fontsize=FONT)
        panel.set_yscale("log" if values.min() > 0 and values.max() > 10 * values.min() else "linear")
        panel.yaxis.set_major_formatter(ScalarFormatter())
        panel.yaxis.set_minor_formatter(ScalarFormatter())
        panel.tick_params(which="both", labelsize=FONT)
        panel.grid(alpha=0.3)
    text = "Each batch's loss, and its running mean: where a curve still falls, more updates would help."
    return Section(f"loss-{name}", f"How {what} learnt", text, png(figure))


def read_points(path: Path) -> Points:
    """The points of a loss curve; `DatasetError` if the file is damaged or empty."""
    try:
        points: Points = [json.loads(line) for line in read_text(path, MOST_BYTES).splitlines() if line]
        names = set(points[0])
        if "update" not in names or any(set(point) != names for point in points):
            raise ValueError("points differ in what they tell")
        if not all(type(each) in (int, float) and abs(each) < MOST for point in points for each in point.values()):
            raise ValueError("a point is no finite number")
    except (OSError, ValueError, TypeError, IndexError, RecursionError) as error:
        raise DatasetError(f"{path} holds no loss curve ({error}); delete it, training writes it again") from error
    return points


def fitness(run: RunFolder) -> Section | None:
    """The population's fitness over a run's generations; `None` before the first has closed."""
    history, evaluations = run.history(), run.evaluations()
    if not history:
        return None
    number, mean, std, best = np.array([(each.number, each.mean, each.std, each.best) for each in history]).T
    figure, axes = new_figure(3.6)
    panel = axes[0, 0]
    panel.fill_between(number, mean - std, mean + std, alpha=0.2, color="tab:blue", label="± 1 standard deviation")
    panel.plot(number, mean, "o-", markersize=3, color="tab:blue", label="mean of the population")
    panel.plot(number, best, color="tab:orange", linewidth=1, label="best candidate")
    stages = begun_stages(run.settings, history, evaluations)
    for each in stages[1:]:
        panel.axvline(each.since - 0.5, color="tab:gray", linestyle="--", linewidth=1)
    panel.set(xlabel="generation", ylabel="fitness")
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    handles = list(panel.get_legend_handles_labels()[0])
    if evaluations:
        # On its own scale: where the run dreams, fitness and score are not of one kind.
        real = panel.twinx()
        generations, means, errors = zip(*((e.generation, e.mean, e.error) for e in evaluations), strict=True)
        handles.append(
            real.errorbar(generations, means, errors, fmt="s", color="tab:green", capsize=3, label="evaluated mean")
        )
        if (confirmed := run.confirmation()) is not None:
            handles.append(
                real.errorbar(
                    confirmed.generation, confirmed.mean, confirmed.error, fmt="*", color="tab:red", capsize=3,
                    markersize=9, label="reported, confirmed",
                )
            )  # fmt: skip
        real.set_ylabel("score of whole episodes", color="tab:green")
    panel.legend(handles=handles, fontsize=FONT, loc="best")
    panel.grid(alpha=0.3)
    horizon = in_turn(str(each.stage.horizon) for each in stages)
    text = f"Run {run.name}, task {run.spec.task}, {horizon} steps an episode: fitness over the generations."
    return Section("fitness", "How its controller evolved", text, png(figure))
