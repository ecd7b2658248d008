"""Plots: one run's fitness over its generations, and learning curves of several runs over the effort spent.

Pages: python.md, own-objective.md, results.md.
"""

import textwrap
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.legend import Legend
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from dreamfleet.common.addons.analysis.fitness_chart import (
    PLAIN,
    PLOT_COLOURS,
    STAR,
    draw_fitness,
    error_bars,
    has_score_panel,
    seeds_note,
)
from dreamfleet.common.addons.analysis.learning import LearningCurve
from dreamfleet.common.addons.analysis.run_archive import RunArchive, exploration_note
from dreamfleet.common.addons.analysis.scored_history import effort_axes, goal_of, spans_decades, steps_text, value_axis
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import open_output
from dreamfleet.common.host.add_ons import add_on
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.tasks import is_function_task
from dreamfleet.common.runs.effort import Effort, format_steps
from dreamfleet.common.runs.records import SUBMITTED
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import begun_stages, join_distinct
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.profile import PublishedScores
from dreamfleet.common.worlds.score_words import score_word
from dreamfleet.common.worlds.shipped import WORLDS

TITLE = 90  # characters in a line of the title
LABEL = 52  # characters in a line of the label of the y axis
LEGEND_PLACE: Final = "outside lower left"
PAD = 0.08  # inches around panels, titles and legends
LINE = 12  # points: the height of a line of the note under a title
DECADE = 10
KINDS = (".png", ".svg")
NEAR_SHARE = 0.1  # of the steps of the first published score: a shorter run's curve would be squeezed beside it
REPEATABLE: dict[Any, str] = {"svg.hashsalt": "dreamfleet"}  # fixed identifiers in SVG files, instead of random ones


class ShownFigure(Figure):
    """A matplotlib figure that a notebook shows where nothing has imported pyplot, which would choose a backend."""

    def _repr_png_(self) -> bytes:
        stream = BytesIO()
        self.savefig(stream, format="png")
        return stream.getvalue()


def fitness_figure(run: RunFolder) -> Figure:
    """One run's fitness over its generations, with its evaluated and confirmed means, as a matplotlib `Figure`.

    `UsageError` before the first generation is closed. It is made without pyplot, so that a notebook keeps its backend.
    """
    if not run.history():
        raise UsageError(f"run {run.name} has no closed generation, so there is nothing to draw: wait for the first")
    settings = run.settings
    stages = begun_stages(settings, run.history(), run.evaluations())
    two = has_score_panel(run)
    figure = ShownFigure(figsize=(8.5, 7.2 if two else 5.2), layout=ConstrainedLayoutEngine(w_pad=PAD, h_pad=PAD))
    shares = [3, 2] if two else [1]
    panels = figure.subplots(len(shares), 1, sharex=True, squeeze=False, height_ratios=shares)[:, 0]
    handles = draw_fitness(list(panels), run)
    steps = steps_text(stages, settings.task, run.episode_limit)
    evaluated = "; evaluated: whole episodes" if run.evaluations() and not two else ""
    limit = textwrap.wrap(f"in {steps} at most{evaluated}", LABEL)
    is_function = is_function_task(settings.task.task)
    is_log = panels[0].get_yscale() == "log"
    label = (value_axis(settings.task, is_log=is_log),) if is_function else ("fitness (sum of rewards)", *limit)
    panels[0].set_ylabel("\n".join(label))
    if two:
        panels[1].set_ylabel("score in reality\n(whole episodes)")
    sizes = (each.stage.settings for each in stages)
    own = join_distinct(f"{each.population} candidates x {plural(each.episodes, 'episode')}" for each in sizes)
    size = SUBMITTED if settings.is_external else own
    _set_titles(panels[0], f"{run.name}: {settings.task.task}, {size}, seed {settings.seed}", _note(run))
    _add_legend(figure, handles, columns=2)
    return figure


def _note(run: RunFolder) -> str:
    """What a reader of the curve must know; of a search that explores also what its archive holds."""
    seeds, explores = seeds_note(run), exploration_note(run.settings)
    archive = RunArchive.of(run) if explores else None
    found = "" if archive is None else f"Archive: {archive.status.description}."
    return " ".join(filter(None, (f"{seeds}." if seeds and explores else seeds, explores, found)))


def draw_runs(runs: Sequence[RunFolder], kind: str) -> Figure:
    """A picture: the `fitness` or the `archive` of one run, or the `learning` of several; `UsageError` for nothing."""
    if kind == "learning":
        curves = [LearningCurve.of(each) for each in runs]
        return learning_figure(curves, published_scores(curves))
    if len(runs) > 1:
        raise UsageError(f"--kind {kind} draws one run: name one")
    figure: Figure = add_on("archive-figure")(runs[0]) if kind == "archive" else fitness_figure(runs[0])
    return figure


def learning_figure(curves: Sequence[LearningCurve], marks: PublishedScores | None) -> Figure:
    """Evaluated scores over environment steps and core-hours, with published scores as `marks`: a matplotlib `Figure`.

    A published score of unknown steps is a horizontal line.

    Environment steps are all steps in reality: of candidates, kept rollouts, evaluations, and of the run that this one
    began from. The legend shows dreamt steps.
    """
    figure = ShownFigure(figsize=(11, 5.6), layout=ConstrainedLayoutEngine(w_pad=PAD, h_pad=PAD))
    over_steps, over_hours = figure.subplots(1, 2, sharey=True)
    one_world = len({each.world for each in curves}) == 1
    for curve, colour in zip(curves, PLOT_COLOURS * len(curves), strict=False):
        name = curve.name if one_world else f"{curve.name} in {curve.world}"
        _draw_curve(over_steps, curve, name, colour, lambda effort: effort.steps)
        _draw_curve(over_hours, curve, name, colour, lambda effort: effort.core_hours)
    if marks is not None:
        for axes, name in ((over_steps, "steps"), (over_hours, "core_hours")):
            spent = [(getattr(each, name), each.score) for each in marks.scores]
            _draw_marks(axes, [(amount, score) for amount, score in spent if amount is not None], marks.source)
        for level in (each.score for each in marks.scores if each.steps is None):
            over_steps.axhline(level, linestyle="--", color="black", linewidth=1, label=marks.source)
            over_hours.axhline(level, linestyle="--", color="black", linewidth=1)
    values = [each.score for curve in curves for each in (*curve.points, curve.confirmed) if each is not None]
    is_log = all(each.minimised for each in curves) and spans_decades(values)
    over_steps.yaxis.set_major_formatter(PLAIN)
    if is_log:
        over_steps.set_yscale("log")  # of both panels: they share the axis
    over_steps.set_ylabel(_score_axis(curves, "log scale" if is_log else ""))
    names = effort_axes(calls=all(is_function_task(each.world) for each in curves))
    for axes, spent_in in zip((over_steps, over_hours), names.values(), strict=True):
        axes.set_xlabel(f"{spent_in}{' (log scale)' if _scale(axes) else ''}")
        axes.margins(y=0.1)
        axes.grid(alpha=0.3, which="major")
    where = f" in {curves[0].world}" if one_world else ""
    title = f"evaluated score{where} over what the search spent: {', '.join(each.name for each in curves)}"
    figure.suptitle("\n".join(textwrap.wrap(title, TITLE)), fontsize=11, x=0.01, ha="left", parse_math=False)
    _add_legend(figure, over_steps.get_legend_handles_labels()[0])
    return figure


def published_scores(curves: Sequence[LearningCurve]) -> PublishedScores | None:
    """The published scores of the world that all curves are of; `None` if the curves are much shorter."""
    worlds = {each.world for each in curves}
    world = WORLDS.get(worlds.pop()) if len(worlds) == 1 else None
    found = world.published if world else None
    if found is not None and max(each.total.steps for each in curves) < NEAR_SHARE * found.first_steps:
        return None
    return found


def _scale(axes: Any) -> bool:
    """Make the x axis logarithmic if its values span a decade, with labels at 20 and 50 too; whether it did."""
    low, high = axes.dataLim.intervalx
    named = FuncFormatter(lambda value, _: f"{value:g}" if value < 1000 else format_steps(round(value)))
    axes.xaxis.set_major_formatter(named)
    if low <= 0 or high < DECADE * low:
        axes.set_xlim(0, 1.05 * high)
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=(1, 2, 5, 10)))
        return False
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(named)
    if high < DECADE**3 * low:
        axes.xaxis.set_minor_locator(LogLocator(subs=(2, 5)))
        axes.xaxis.set_minor_formatter(named)
        axes.tick_params(axis="x", which="minor", length=mpl.rcParams["xtick.major.size"])
    else:
        axes.xaxis.set_minor_formatter(NullFormatter())
    return True


def _draw_curve(axes: Any, curve: LearningCurve, name: str, colour: str, spent: Callable[[Effort], float]) -> None:
    """Plot evaluations as a line. The confirmed score is a hollow star, dotted to the same mean's evaluation."""
    points, last, reported = curve.points, curve.confirmed, curve.reported
    efforts, scores = [spent(each.effort) for each in points], [each.score for each in points]
    label = f"{name}: {curve.total.describe(curve.world)}"
    line = {"fmt": "o-", "markersize": 4, "linewidth": 1.2, "capsize": 2}
    axes.errorbar(efforts, scores, error_bars(points), color=colour, label=label, **line)
    if last is None:
        return
    if reported is not None:
        ends = [spent(reported.effort), spent(last.effort)], [reported.score, last.score]
        axes.plot(*ends, ":", color=colour, linewidth=1)
    score = format_with_error(last.score, last.error)
    axes.errorbar(
        spent(last.effort), last.score, error_bars([last]), fmt="*", color=colour, **STAR,
        label=f"{curve.name}, confirmed on fresh {score_word(curve.world)}s: {score}",
    )  # fmt: skip


def _draw_marks(axes: Any, marks: Sequence[tuple[float, float]], source: str) -> None:
    if not marks:
        return
    axes.plot(*zip(*marks, strict=True), "s--", color="black", markersize=5, linewidth=1, label=source)
    for number, (spent, score) in enumerate(marks):  # alternate sides, so that labels do not overlap
        place = (0, 7 if number % 2 else -14)
        axes.annotate(f"{score:zg}", (spent, score), place, textcoords="offset points", ha="center", fontsize=9)


def _set_titles(axes: Any, title: str, note: str) -> None:
    """Write a title from the left edge, and under it a note in grey."""
    lines = textwrap.wrap(note, TITLE)
    wrapped = "\n".join(textwrap.wrap(title, TITLE))
    axes.set_title(wrapped, fontsize=11, loc="left", pad=6 + LINE * len(lines), parse_math=False)
    place = {"xycoords": "axes fraction", "xytext": (0, 6), "textcoords": "offset points"}
    axes.annotate("\n".join(lines), (0, 1), **place, fontsize=9, color="dimgray", annotation_clip=False)


def _add_legend(figure: Figure, handles: Sequence[Any], columns: int = 1) -> None:
    """Put a legend under the panels, in one column if more would be wider than the figure."""
    for count in (columns, 1):
        legend = figure.legend(
            handles=handles, loc=LEGEND_PLACE, ncols=count, fontsize=9, frameon=False, borderaxespad=1
        )
        show_as_is(legend)
        if count == 1 or legend.get_window_extent().width < figure.bbox.width:
            return
        legend.remove()


def show_as_is(legend: Legend) -> None:
    """Have a legend's names stand as they are: a pair of `$` in them is no formula."""
    for each in legend.get_texts():
        each.set_parse_math(False)


def _score_axis(curves: Sequence[LearningCurve], scale: str) -> str:
    if all(is_function_task(each.world) for each in curves):
        goals = {goal_of(minimised=each.minimised) for each in curves}
        about = ", ".join(filter(None, (*(goals if len(goals) == 1 else ()), scale)))
        return f"value of the function at the mean{f' ({about})' if about else ''}"
    word = score_word(curves[0].world) if len({each.world for each in curves}) == 1 else "seed"
    return f"score of the mean (± standard error)\nin whole episodes on validation {word}s"


def save_figure(figure: Any, path: Path) -> None:
    """Write the figure atomically in the format of the file name; equal figures give equal files."""
    metadata = {"Date": None} if path.suffix == ".svg" else None
    with open_output(path) as file, mpl.rc_context(REPEATABLE):
        figure.savefig(file, format=path.suffix.removeprefix("."), dpi=120, metadata=metadata)
