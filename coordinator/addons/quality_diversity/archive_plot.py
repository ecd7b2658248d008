"""A run's archive as a heat map: the elites' fitness in the cells of the first two axes, and the cells' numbers."""

import textwrap
from typing import Any

import numpy as np

from dreamfleet.common.addons.analysis.run_archive import RunArchive, describe_measure
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import format_number
from dreamfleet.common.protocol.measures import Axis
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.runs.plot import TITLE, ShownFigure

EMPTY = "#f2f2f2"  # of cells without an elite
MOST_LABELS = 13  # of an axis
LABEL = 66  # characters in a line of an axis' name


def archive_figure(run: RunFolder) -> ShownFigure:
    """The elites' fitness over the archive's axes, as a matplotlib `Figure`.

    Over more than two axes a cell shows its best elite. `UsageError` for a run without an archive, or an empty one.
    """
    archive = RunArchive.of(run)
    if archive is None or not archive.elites:
        what = "has no archive: begin one with --archive" if archive is None else "has no elite yet: wait for the first"
        raise UsageError(f"run {run.name} {what}")
    first, second = archive.shown_axes
    figure = ShownFigure(figsize=(8, 6), layout="constrained")
    axes = figure.subplots()
    axes.set_facecolor(EMPTY)
    mesh = axes.pcolormesh(
        first.edges, second.edges, np.ma.masked_invalid(archive.grid().T), cmap="viridis", edgecolors="white",
        linewidth=0.3 if first.cells * second.cells <= 2500 else 0,
    )  # fmt: skip
    _label(axes.xaxis, axes.secondary_xaxis("top").xaxis, first, "first number of --cell")
    if second.measure:
        _label(axes.yaxis, axes.secondary_yaxis("right").yaxis, second, "second number of --cell")
    else:
        axes.set_yticks([])
    if (best := archive.best) is not None:
        middle = [axis.middles[cell] for axis, cell in zip((first, second), (*best.cell, 0), strict=False)]
        axes.plot(*middle, "*", color="white", markeredgecolor="black", markersize=13)
    bar = figure.colorbar(mesh, ax=axes, pad=0.03)
    bar.set_label("fitness of the elite (sum of rewards, mean over its episodes)")
    filled = f"{len(archive.elites)} of {archive.cells} cells filled (empty ones are grey)"
    lines = [f"{run.name}: {filled}", f"QD score {format_number(archive.qd_score)}"]
    if best is not None:
        lines[1] += f"; star: the best, --cell {','.join(map(str, best.cell))}"
    if len(archive.axes) > 2:
        lines.append("each cell shows its best over the other axes")
    title = "\n".join(line for each in lines for line in textwrap.wrap(each, TITLE))
    axes.set_title(title, fontsize=11, parse_math=False)
    return figure


def _label(values: Any, numbers: Any, axis: Axis, name: str) -> None:
    """Real values at bounds of cells on one side of the picture, and the cells' numbers on the other."""
    every = -(-axis.cells // MOST_LABELS)
    values.set_ticks(axis.edges[::every], labels=[f"{each:.3g}" for each in axis.edges[::every].tolist()])
    values.set_tick_params(labelsize=8)
    values.set_label_text("\n".join(textwrap.wrap(describe_measure(axis.measure), LABEL)), parse_math=False)
    numbers.set_ticks(axis.middles[::every], labels=[str(each) for each in range(axis.cells)[::every]])
    numbers.set_tick_params(length=0, labelsize=8)
    numbers.set_label_text(name)
