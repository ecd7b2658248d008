"""Draw the sections' figures as PNG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

WIDTH = 10.0  # inches: 1100 pixels, the width of the page
DPI = 110
FONT = 9
Pictures = NDArray[np.uint8]


def new_figure(height: float, rows: int = 1, columns: int = 1, **settings: Any) -> tuple[Figure, NDArray[Any]]:
    """Make a figure as wide as the page; return it and its axes `(rows, columns)`."""
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **settings)
    for each in axes.ravel():
        each.tick_params(labelsize=FONT)
    return figure, axes


def render_png(figure: Figure) -> bytes:
    """Render a figure as PNG without matplotlib's version in it, so that equal figures give equal bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def picture_grid(rows: Sequence[tuple[str, Pictures]], columns: Sequence[str]) -> bytes:
    """Draw rows of pictures `(N, side, side, 3)` with a label per row and a heading per column."""
    side = (WIDTH - 1.6) / max(len(columns), 5)
    figure, axes = new_figure(len(rows) * (side + 0.05) + 0.35, len(rows), len(columns))
    for (label, pictures), line in zip(rows, axes, strict=True):
        for each, picture in zip(line, pictures, strict=True):
            each.imshow(picture, interpolation="nearest")
            each.set(xticks=[], yticks=[])
            each.spines[:].set_visible(False)
        line[0].set_ylabel(label, rotation=0, ha="right", va="center", fontsize=FONT + 1)
    for each, heading in zip(axes[0], columns, strict=True):
        each.set_title(heading, fontsize=FONT + 1)
    return render_png(figure)


def draw_heatmap(axes: Any, values: NDArray[Any], title: str, **settings: Any) -> None:
    """Draw values `(rows, steps)` as colours beside a colour bar."""
    image = axes.imshow(values, aspect="auto", interpolation="nearest", **settings)
    axes.set_title(title, fontsize=FONT + 1)
    bar = axes.figure.colorbar(image, ax=axes, pad=0.01)
    bar.ax.tick_params(labelsize=FONT)
