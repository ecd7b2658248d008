"""The scores of an evaluation as a picture: one point a seed, the mean with its standard error, and a histogram."""

import io

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dreamfleet.common.addons.evaluation_report import EvaluationReport
from dreamfleet.common.printable import plural
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.score_words import score_word

COLOUR, MEAN = "#3b6ea5", "#c0392b"


def draw_scores(report: EvaluationReport, name: str) -> bytes:
    """Draw a report's scores as PNG; equal reports give equal bytes."""
    found, word = report.results, score_word(report.world)
    figure = Figure(figsize=(8, 3.6), dpi=120, layout="constrained")
    points, counts = figure.subplots(1, 2, sharey=True, width_ratios=(4, 1))
    scores, middle = [*map(found.shown, found.scores)], found.shown(found.mean)
    points.plot(found.seeds, scores, "o", color=COLOUR, markersize=4, alpha=0.7)
    counts.hist(scores, bins=20, orientation="horizontal", color=COLOUR, alpha=0.7)
    error = found.error or 0.0
    for axes in (points, counts):
        axes.axhspan(middle - error, middle + error, color=MEAN, alpha=0.25, linewidth=0)
        mean = axes.axhline(middle, color=MEAN, linewidth=1, label="mean and its standard error")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", alpha=0.3)
    lines = [mean]
    if report.threshold is not None:
        label = f"threshold of {report.threshold:g}"
        lines.append(points.axhline(report.threshold, color="black", linewidth=1, linestyle=":", label=label))
    points.ticklabel_format(useOffset=False)
    for axes in (points, counts):
        axes.xaxis.set_major_locator(MaxNLocator(nbins="auto", integer=True))
    points.set(
        xlabel=f"seed of the {word}" if word != "seed" else "seed", ylabel="value" if found.minimised else "score"
    )
    counts.set(xlabel=f"{word}s")
    figure.legend(handles=lines, loc="outside lower right", ncols=2, frameon=False, fontsize=9)
    mean_text = format_with_error(middle, found.error)
    title = f"{name}: {mean_text} (standard error) on {plural(len(found.drives), word)}"
    figure.suptitle(title, fontsize=11, x=0.01, ha="left", parse_math=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
