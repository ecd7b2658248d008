"""Sections with curves: the losses of trainings, the fitness of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, ScalarFormatter
from numpy.typing import NDArray

from dreamfleet.common.addons.analysis.fitness_chart import PLOT_COLOURS, draw_fitness, has_score_panel
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import begun_stages, join_distinct
from dreamfleet.worker.addons.inspection.charts import FONT, new_figure, render_png
from dreamfleet.worker.addons.inspection.page import Section
from dreamfleet.worker.addons.inspection.training_curves import MODELS, UNITS, LossCurve, TrainingCurves

MARKERS = ("o", "s", "^", "D", "v", "P", "X")
MARKED = 25  # approximate number of markers on a line
Styles = tuple[dict[str, Any], dict[str, Any]]


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
    """Draw a panel for each part of a loss, with the curves of batches and held-out drives of each training."""
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
        return
    panel.yaxis.set_major_formatter(ScalarFormatter())


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
