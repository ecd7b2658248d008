"""Parts of charts that runs and trainings share: colours, and a run's fitness by generation."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
from matplotlib.ticker import MaxNLocator

from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import begun_stages
from dreamfleet.common.worlds.score_words import score_word_of_run


class ScoreWithError(Protocol):
    """A mean that has a standard error, or none of one episode."""

    @property
    def error(self) -> float | None:
        """The standard error."""


# Of a confirmed score: its error bar, which may be short, shows within the marker.
HOLLOW_STAR: dict[str, Any] = {"markersize": 13, "markerfacecolor": "none", "markeredgewidth": 1.5, "capsize": 4}
PLOT_COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:olive")


def draw_fitness(axes: Any, run: RunFolder) -> list[Any]:
    """Draw each generation's mean, spread and best fitness, the evaluations and the confirmed score.

    Evaluations have a second axis if candidates only dream: dreamed fitness and real score are not comparable. Returns
    the handles for a legend.
    """
    history, evaluations, settings = run.history(), run.evaluations(), run.settings
    number, mean, std, best = np.array([(each.number, each.mean, each.std, each.best) for each in history]).T
    spread = "± 1 standard deviation of the candidates"
    axes.fill_between(number, mean - std, mean + std, alpha=0.2, color="tab:blue", label=spread)
    axes.plot(number, mean, color="tab:blue", label="mean of the population")
    axes.plot(number, best, color="tab:orange", linewidth=1, label="best candidate")
    stages = begun_stages(settings, history, evaluations)
    for count, each in enumerate(stages[1:]):
        label = None if count else "a stage begins"
        axes.axvline(each.since - 0.5, color="tab:gray", linestyle="--", linewidth=1, label=label)
    axes.set_xlabel("generation")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    dreamt = settings.task.task == DREAM
    dreams_only = dreamt and not any(each.stage.driven for each in stages)
    real = axes.twinx() if dreams_only and evaluations else axes
    if evaluations:
        word = score_word_of_run(run.spec, run.bundle_path)
        episodes = f"{settings.evaluation_episodes} {word}s, whole episodes"
        real.errorbar(
            [each.generation for each in evaluations], [each.mean for each in evaluations],
            error_bars(evaluations), fmt="o-" if dreamt else "o", color="tab:green", capsize=3,
            label=f"evaluated mean{' in reality' if dreamt else ''}, {episodes} (± standard error)",
        )  # fmt: skip
        _draw_confirmed(real, run)
    if real is not axes:
        real.set_ylabel(f"score in reality, {episodes}", color="tab:green")
    drawn = (axes,) if real is axes else (axes, real)
    return [handle for each in drawn for handle in each.get_legend_handles_labels()[0]]


def error_bars(found: Iterable[ScoreWithError]) -> list[float]:
    """The lengths of error bars; a score without a standard error has no bar."""
    return [np.nan if each.error is None else each.error for each in found]


def _draw_confirmed(axes: Any, run: RunFolder) -> None:
    """Draw the run's confirmed score; it is often below the best evaluation, which is partly luck."""
    if (confirmed := run.confirmation()) is not None:
        word = score_word_of_run(run.spec, run.bundle_path)
        axes.errorbar(
            confirmed.generation, confirmed.mean, error_bars([confirmed]), fmt="*", color="tab:red", **HOLLOW_STAR,
            label=f"reported: confirmed on {confirmed.episodes} fresh {word}s (± standard error)",
        )  # fmt: skip
