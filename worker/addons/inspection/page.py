"""An HTML page of sections that needs no other file, and the figures in them as PNG."""

import io
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

WIDTH = 10.0  # inches of a figure: 1100 pixels, the width of the page
DPI = 110
FONT = 9
Pictures = NDArray[np.uint8]
STYLE = """
body { margin: 2.5rem auto; max-width: 1100px; padding: 0 1.5rem; color: #1c2026; background: #fff;
  font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; }
h1 { margin-bottom: 0; } h2 { margin: 2.5rem 0 .3rem; border-top: 1px solid #d9dde3; padding-top: 1.2rem; }
p { margin: .3rem 0 1rem; max-width: 75ch; } .about { color: #5b6470; overflow-wrap: anywhere; }
img { display: block; width: 100%; }
table { border-collapse: collapse; margin: 1.5rem 0; font-size: 15px; }
th, td { text-align: left; padding: .3rem 1.5rem .3rem 0; border-bottom: 1px solid #d9dde3; font-weight: normal; }
th { color: #5b6470; } td { font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
"""


@dataclass(frozen=True)
class Section:
    """A section: title, explanation and perhaps a PNG `picture`; `name` is the section's id and its file's name.

    `figures` are what is drawn, by name, for JSON.
    """

    name: str
    title: str
    text: str
    picture: bytes | None = None
    figures: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Page:
    """A page: title, a line about its subject, a table of facts, and sections."""

    title: str
    about: str
    facts: Sequence[tuple[str, str]]
    sections: Sequence[Section]

    def html(self) -> str:
        """Render the page; pictures become data URIs."""
        rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>\n" for name, value in self.facts)
        body = "".join(_section(each) for each in self.sections)
        return (
            f'<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8"><title>{escape(self.title)}</title>\n'
            f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>\n<body>\n'
            f'<h1>{escape(self.title)}</h1>\n<p class="about">{escape(self.about)}</p>\n'
            f"<table>\n{rows}</table>\n{body}</body>\n</html>\n"
        )


def _section(section: Section) -> str:
    image = ""
    if section.picture is not None:
        data = b64encode(section.picture).decode()
        image = f'<img alt="{escape(section.title)}" src="data:image/png;base64,{data}">\n'
    return (
        f'<section id="{escape(section.name)}">\n<h2>{escape(section.title)}</h2>\n<p>{escape(section.text)}</p>\n'
        f"{image}</section>\n"
    )


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
        each.set_title(heading, fontsize=FONT + 1, parse_math=False)  # it may be the name of a file
    return render_png(figure)


def draw_heatmap(axes: Any, values: NDArray[Any], title: str, **settings: Any) -> None:
    """Draw values `(rows, steps)` as colours beside a colour bar."""
    image = axes.imshow(values, aspect="auto", interpolation="nearest", **settings)
    axes.set_title(title, fontsize=FONT + 1)
    bar = axes.figure.colorbar(image, ax=axes, pad=0.01)
    bar.ax.tick_params(labelsize=FONT)
