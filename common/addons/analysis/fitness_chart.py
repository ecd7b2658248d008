"""Parts of charts that runs and trainings share: colours, and a run's fitness by generation.

Pages: own-objective.md, python.md.
"""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from dreamfleet.common.addons.analysis.learning import Point
from dreamfleet.common.addons.analysis.scored_history import log_foot, scored_history, spread_of
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.tasks import DREAM, is_function_task
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation, in_values
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import BegunStage, begun_stages
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.score_words import score_word_of_run

Judged = Point | StoredEvaluation | StoredConfirmation
# Of a confirmed score: a white edge sets it apart from lines and error bars behind it, and no edge of a panel cuts it.
STAR: dict[str, Any] = {
    "markersize": 14, "markeredgecolor": "white", "markeredgewidth": 1, "capsize": 4, "zorder": 5, "clip_on": False
}  # fmt: skip
PLOT_COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:olive")
PLAIN = "{x:,.10g}"  # of the numbers of an axis: whole ones, without an offset beside them
FEW_EPISODES = 4  # of a candidate, up to which luck with a generation's seeds is visible in its mean
WINDOW = 9  # generations of a running median; a run of twice as many has one


def has_score_panel(run: RunFolder) -> bool:
    """Whether evaluated means need a panel of their own: candidates only dream, and a dream's fitness is no score."""
    evaluations = run.evaluations()
    dreams = run.settings.task.task == DREAM
    return bool(evaluations) and dreams and not any(each.stage.settings.driven for each in _stages(run))


def draw_fitness(panels: Sequence[Any], run: RunFolder) -> list[Any]:
    """Draw each generation's mean, spread and best fitness, the evaluations and the confirmed score.

    `panels` are one pair of axes, or two, above each other, if the run `has_score_panel`. Returns the handles for a
    legend.
    """
    task, evaluations, stages = run.spec, run.evaluations(), _stages(run)
    history = [in_values(each, task) for each in scored_history(run)]
    in_decades = log_foot(history, [in_values(each, task) for each in evaluations], task) is not None
    columns = np.array([(each.number, each.mean, each.best, *spread_of(each)) for each in history]).T
    mean = columns[1]
    axes, scores = panels[0], panels[-1]
    smooth = running_median(mean, [each.since for each in stages])
    thin = {} if smooth is None else {"linewidth": 0.8, "alpha": 0.6}
    jumps = [each.since for each in stages if each.stage.restart or each.origin is not None]
    smoothed = mean if smooth is None else smooth
    number, mean, best, low, high, smoothed = _break_lines(jumps, *columns, smoothed)
    known = np.pad(~np.isnan(mean), 1)
    lone = np.flatnonzero(known[1:-1] & ~known[:-2] & ~known[2:]).tolist()  # no line leads to or from them
    dots = {"marker": "o", "markevery": lone} if lone else {}
    axes.plot(number, mean, color="tab:blue", label="average of the candidates", **thin, **dots)
    if smooth is not None:
        label = f"its running median over {WINDOW} generations"
        axes.plot(number, smoothed, color="tab:blue", linewidth=2.2, label=label)
    spread = "± 1 standard deviation (cut at worst and best)"
    axes.fill_between(number, low, high, alpha=0.2, color="tab:blue", linewidth=0, label=spread)
    axes.plot(number, best, color="tab:orange", linewidth=1, label="best candidate", **dots)
    for panel in panels:
        for count, each in enumerate(stages[1:]):
            named = {} if count or panel is not axes else {"label": "a stage begins"}
            panel.axvline(each.since - 0.5, color="tab:gray", linestyle="--", linewidth=1, **named)
        panel.margins(x=0.03)
        panel.xaxis.set_major_locator(MaxNLocator(9, integer=True, steps=(1, 2, 5, 10)))
        panel.yaxis.set_major_formatter(PLAIN)
        panel.grid(alpha=0.3)
    scores.set_xlabel("generation")
    if evaluations:
        _draw_evaluations(scores, run, jumps)
    if in_decades:
        axes.set_yscale("log")
    return [handle for each in dict.fromkeys(panels) for handle in each.get_legend_handles_labels()[0]]


def seeds_note(run: RunFolder) -> str:
    """What a reader must know of a candidate's few episodes; empty if it has many."""
    episodes = sorted({each.stage.settings.episodes for each in _stages(run)})
    if (
        run.settings.is_external
        or is_function_task(run.spec.task)
        or episodes[0] > FEW_EPISODES
        or len(run.history()) < 2
    ):
        return ""
    counted = plural(episodes[0], "episode") if len(episodes) == 1 else f"{episodes[0]} to {episodes[-1]} episodes"
    return f"{counted} a candidate: seeds differ from one generation to the next, and some are harder"


def running_median(values: NDArray[np.float64], begins: Sequence[int] = (0,)) -> NDArray[np.float64] | None:
    """The median of `WINDOW` values around each of `values` `(n,)`, of fewer at the ends; `None` for a short run.

    Values before and after an index in `begins` never mix: a stage may change what a fitness means.

    >>> running_median(np.array([0.0, 9.0] * 9))[:6].tolist()
    [0.0, 4.5, 0.0, 4.5, 0.0, 9.0]
    """
    if len(values) < 2 * WINDOW:
        return None
    half, smooth = WINDOW // 2, np.empty_like(values)
    for first, last in pairwise((*begins, len(values))):
        for place in range(first, last):
            near = values[max(first, place - half) : min(last, place + half + 1)]
            known = near[~np.isnan(near)]
            smooth[place] = np.median(known) if len(known) else np.nan
    return smooth


def _break_lines(jumps: Sequence[int], number: ArrayLike, *values: ArrayLike) -> list[NDArray[np.float64]]:
    """`number` and what is drawn over it, with a gap before each of `jumps`, where the search goes on elsewhere."""
    places = np.searchsorted(number, jumps)
    return [np.insert(np.asarray(each, dtype=np.float64), places, np.nan) for each in (number, *values)]


def error_bars(found: Iterable[Judged]) -> list[float]:
    """The lengths of error bars; a score without a standard error has no bar."""
    return [np.nan if each.error is None else each.error for each in found]


def _stages(run: RunFolder) -> Sequence[BegunStage]:
    history = run.history()
    return [each for each in begun_stages(run.settings, history, run.evaluations()) if each.since < len(history)]


def _draw_evaluations(axes: Any, run: RunFolder, jumps: Sequence[int]) -> None:
    """Draw the evaluated means and the confirmed score, which is often below the best of them, as that is luck too."""
    evaluations = [in_values(each, run.spec) for each in run.evaluations()]
    confirmed = in_values(run.confirmation(), run.spec)
    word, episodes = score_word_of_run(run.spec, run.bundle_path), run.settings.evaluation_episodes
    seeds = "" if episodes == 1 else f" ± standard error, {episodes} {word}s"
    number, mean, error = _break_lines(
        jumps, [each.generation for each in evaluations], [each.mean for each in evaluations], error_bars(evaluations)
    )
    axes.errorbar(
        number, mean, error, fmt="o-", color="tab:green", capsize=3, linewidth=1, zorder=3,
        label=f"evaluated mean{seeds}",
    )  # fmt: skip
    if confirmed is not None:
        score = format_with_error(confirmed.mean, confirmed.error)
        axes.errorbar(
            confirmed.generation, confirmed.mean, error_bars([confirmed]), fmt="*", color="tab:red", **STAR,
            label=f"reported: {score} on {plural(confirmed.episodes, f'fresh {word}')}",
        )  # fmt: skip
