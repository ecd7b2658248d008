"""Plots: one run's fitness over its generations, and learning curves of several runs over the effort spent."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import open_output
from dreamfleet.common.monitoring.fitness_chart import HOLLOW_STAR, PLOT_COLOURS, draw_fitness, error_bars
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.effort import SHORT_HOURS, Effort, format_steps
from dreamfleet.common.runs.learning import LearningCurve
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import begun_stages, describe_steps, join_distinct
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.profile import PublishedScores
from dreamfleet.common.worlds.score_words import score_word
from dreamfleet.common.worlds.shipped import WORLDS

TITLE = 90  # characters in a line of the title
LABEL = 52  # characters in a line of the label of the y axis
DECADE = 10
KINDS = (".png", ".svg")
NEAR_SHARE = 0.1  # of the steps of the first published score: a shorter run's curve would be squeezed beside it
REPEATABLE: dict[Any, str] = {"svg.hashsalt": "dreamfleet"}  # fixed identifiers in SVG files, instead of random ones


def plot_fitness(run: RunFolder, path: Path) -> None:
    """Write the picture of `fitness_figure`."""
    _save(fitness_figure(run), path)


def fitness_figure(run: RunFolder) -> Any:
    """One run's fitness over its generations, with its evaluated and confirmed means, as a matplotlib `Figure`.

    `UsageError` before the first generation is closed. It is made without pyplot, so that a notebook keeps its backend.
    """
    if not run.history():
        raise UsageError(f"run {run.name} has no closed generation, so there is nothing to draw: wait for the first")
    settings = run.settings
    stages = begun_stages(settings, run.history(), run.evaluations())
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    handles = draw_fitness(axes, run)
    size = join_distinct(
        f"{each.stage.population} candidates x {plural(each.stage.episodes, 'episode')}" for each in stages
    )
    dreamt = settings.task.task == DREAM
    steps = join_distinct(describe_steps(each.stage.horizon, each.stage.driven, dreamt=dreamt) for each in stages)
    axes.set_ylabel(f"fitness over {steps} (sum of rewards)")
    title = f"{run.name}: {settings.task.task}, {size}, seed {settings.seed}"
    axes.set_title("\n".join(textwrap.wrap(title, TITLE)), fontsize=11)
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure


def plot_learning(curves: Sequence[LearningCurve], marks: PublishedScores | None, path: Path) -> None:
    """Write the picture of `learning_figure`."""
    _save(learning_figure(curves, marks), path)


def learning_figure(curves: Sequence[LearningCurve], marks: PublishedScores | None) -> Any:
    """Evaluated scores over environment steps and core-hours, with published scores as `marks`: a matplotlib `Figure`.

    A published score of unknown steps is a horizontal line.

    Environment steps are all steps in reality: of candidates, kept rollouts, evaluations, and of the run that this one
    began from. The legend shows dreamt steps.
    """
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    over_steps, over_hours = figure.subplots(1, 2, sharey=True)
    one_world = len({each.world for each in curves}) == 1
    short = marks is None and max(each.total.core_hours for each in curves) < SHORT_HOURS
    unit, hour = ("core-seconds", 3600) if short else ("core-hours", 1)
    for curve, colour in zip(curves, PLOT_COLOURS * len(curves), strict=False):
        name = curve.name if one_world else f"{curve.name} in {curve.world}"
        _draw_curve(over_steps, curve, name, colour, lambda effort: effort.steps)
        _draw_curve(over_hours, curve, name, colour, lambda effort: hour * effort.core_hours)
    if marks is not None:
        for axes, name in ((over_steps, "steps"), (over_hours, "core_hours")):
            spent = [(getattr(each, name), each.score) for each in marks.scores]
            _draw_marks(axes, [(amount, score) for amount, score in spent if amount is not None], marks.source)
        for level in (each.score for each in marks.scores if each.steps is None):
            over_steps.axhline(level, linestyle="--", color="black", linewidth=1, label=marks.source)
            over_hours.axhline(level, linestyle="--", color="black", linewidth=1)
    over_steps.set_ylabel(_score_axis(curves))
    for axes, spent_in in (
        (over_steps, "environment steps in reality, evaluations included"),
        (over_hours, f"{unit}: time that slots worked on accepted results"),
    ):
        axes.set_xlabel(f"{spent_in}{' (log scale)' if _scale(axes) else ''}")
        axes.margins(y=0.1)
        axes.grid(alpha=0.3, which="major")
    figure.legend(*over_steps.get_legend_handles_labels(), loc="outside lower center", fontsize=9, frameon=False)
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
        axes.set_xlim(left=0)
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
    axes.errorbar(
        [spent(each.effort) for each in points],
        [each.score for each in points],
        error_bars(points),
        fmt="o-",
        color=colour,
        markersize=4,
        linewidth=1.2,
        capsize=2,
        label=f"{name}: {curve.total.description}",
    )
    if last is None:
        return
    if reported is not None:
        ends = [spent(reported.effort), spent(last.effort)], [reported.score, last.score]
        axes.plot(*ends, ":", color=colour, linewidth=1)
    score = format_with_error(last.score, last.error)
    axes.errorbar(
        spent(last.effort), last.score, error_bars([last]), fmt="*", color=colour, **HOLLOW_STAR,
        label=f"{curve.name}, confirmed on fresh {score_word(curve.world)}s: {score}",
    )  # fmt: skip


def _draw_marks(axes: Any, marks: Sequence[tuple[float, float]], source: str) -> None:
    if not marks:
        return
    axes.plot(*zip(*marks, strict=True), "s--", color="black", markersize=5, linewidth=1, label=source)
    for number, (spent, score) in enumerate(marks):  # alternate sides, so that labels do not overlap
        place = (0, 7 if number % 2 else -14)
        axes.annotate(f"{score:g}", (spent, score), place, textcoords="offset points", ha="center", fontsize=9)


def _score_axis(curves: Sequence[LearningCurve]) -> str:
    worlds = {each.world for each in curves}
    world = f"{worlds.pop()}: " if len(worlds) == 1 else ""
    word = score_word(curves[0].world) if world else "seed"
    text = f"{world}score of the mean, whole episodes on validation {word}s, ± standard error"
    return "\n".join(textwrap.wrap(text, LABEL))


def _save(figure: Any, path: Path) -> None:
    """Write the figure atomically in the format of the file name; equal figures give equal files."""
    metadata = {"Date": None} if path.suffix == ".svg" else None
    with open_output(path) as file, mpl.rc_context(REPEATABLE):
        figure.savefig(file, format=path.suffix.removeprefix("."), dpi=120, metadata=metadata)
