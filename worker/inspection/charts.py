"""Figures as PNG: what every section is drawn with."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

WIDTH = 10.0  # inches: 1100 pixels, the page's own width
DPI = 110
FONT = 9
Pictures = NDArray[np.uint8]


def new_figure(height: float, rows: int = 1, columns: int = 1, **settings: Any) -> tuple[Figure, NDArray[Any]]:
    """A figure of the page's width, and its axes `(rows, columns)`."""
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **settings)
    for each in axes.ravel():
        each.tick_params(labelsize=FONT)
    return figure, axes


def render_png(figure: Figure) -> bytes:
    """The figure's PNG, without the version that drew it: equal figures give equal bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def picture_grid(rows: Sequence[tuple[str, Pictures]], columns: Sequence[str]) -> bytes:
    """Rows of pictures `(N, side, side, 3)`, each row with its label, each column with its heading."""
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
    """Values `(rows, steps)` as colours, with their scale beside them."""
    image = axes.imshow(values, aspect="auto", interpolation="nearest", **settings)
    axes.set_title(title, fontsize=FONT + 1)
    bar = axes.figure.colorbar(image, ax=axes, pad=0.01)
    bar.ax.tick_params(labelsize=FONT)
