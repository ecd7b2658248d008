"""Learning curves of a sweep, by setting."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from matplotlib.figure import Figure

from dreamfleet.common.addons.analysis.fitness_chart import PLOT_COLOURS
from dreamfleet.common.addons.analysis.scored_history import spans_decades
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.function_values import is_minimised
from dreamfleet.common.protocol.tasks import is_function_task
from dreamfleet.coordinator.addons.runs.plot import save_figure, show_as_is
from dreamfleet.experiments.sweep.summary import RunResult, mean_curve, with_goal, word_of

FEWEST = 3  # evaluations of a run that make a curve
LEGEND_PLACE: Final = "outside lower center"
MARKERS = "os^vDPX*"
DASHES = ("-", (0, (4, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2)))


def plot_sweep(results: Sequence[RunResult], path: Path) -> bool:
    """Write the picture of `sweep_figure`; return whether there was anything to draw."""
    if not any(each.fitness for each in results):
        return False
    save_figure(sweep_figure(results), path)
    return True


def sweep_figure(results: Sequence[RunResult]) -> Any:
    """A thin line for each run and a thick one for each setting's mean, with a band of one standard error among runs.

    Evaluated means, or where some run has less than three the mean fitness of each generation: a matplotlib `Figure`.
    Settings differ by marker and dashes too, so that coinciding lines are seen.
    """
    evaluated, results = all(len(each.evaluated) >= FEWEST for each in results), [each.in_values for each in results]
    figure = Figure(figsize=(9, 5.6), layout="constrained")
    axes = figure.subplots()
    settings = list(dict.fromkeys(each.setting for each in results))
    for number, (setting, colour) in enumerate(zip(settings, PLOT_COLOURS * len(settings), strict=False)):
        marker, dashes = MARKERS[number % len(MARKERS)], DASHES[number % len(DASHES)]
        curves = [each.evaluated if evaluated else each.fitness for each in results if each.setting == setting]
        for curve in curves:
            axes.plot(
                [each.steps for each in curve], [each.score for each in curve], "-", color=colour, alpha=0.3, lw=1
            )
        mean = mean_curve(curves)
        steps, scores = [each[0] for each in mean], [each[1] for each in mean]
        errors = [each[2] or 0.0 for each in mean]
        label = f"{setting} ({plural(len(curves), 'run')})"
        axes.plot(steps, scores, color=colour, marker=marker, ms=5, markevery=0.1, ls=dashes, lw=2, label=label)
        low, high = ([s + sign * e for s, e in zip(scores, errors, strict=True)] for sign in (-1, 1))
        axes.fill_between(steps, low, high, color=colour, alpha=0.15, lw=0)
    is_function = all(each.task is not None and is_function_task(each.task.task) for each in results)
    axes.set_xlabel("calls for candidates" if is_function else "environment steps of candidates")
    judged = f"{'value at' if is_function else 'score of'} the evaluated mean"
    kind = judged if evaluated else f"mean {word_of(results)} of a generation"
    minimised = all(each.task is not None and is_minimised(each.task) for each in results)
    drawn = [each.score for run in results for each in (run.evaluated if evaluated else run.fitness)]
    if minimised and spans_decades(drawn):
        axes.set_yscale("log")
        kind += ", log scale"
    axes.set_ylabel(with_goal(kind, results))
    axes.grid(alpha=0.3)
    show_as_is(figure.legend(loc=LEGEND_PLACE, ncols=2, fontsize=9, frameon=False))
    return figure
