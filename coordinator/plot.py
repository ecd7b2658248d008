"""A run's fitness over its generations, as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MaxNLocator

from dreamfleet.common.runs import RunFolder
from dreamfleet.common.stages import begun_stages, in_turn

DREAM = "dream"


def plot_fitness(run: RunFolder, path: Path) -> None:
    """Write a PNG: each generation's mean, spread and best; evaluations and the confirmed mean where there are any."""
    history, evaluations, settings = run.history(), run.evaluations(), run.settings
    number = np.array([each.number for each in history])
    mean = np.array([each.mean for each in history])
    std = np.array([each.std for each in history])
    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    dreamt = settings.task.task == DREAM
    axes.fill_between(number, mean - std, mean + std, alpha=0.2, color="tab:blue", label="± 1 standard deviation")
    axes.plot(number, mean, color="tab:blue", label="mean of the population")
    axes.plot(number, [each.best for each in history], color="tab:orange", linewidth=1, label="best candidate")
    stages = begun_stages(settings, history, evaluations)
    for each in stages[1:]:
        label = "a stage begins" if each is stages[1] else None
        axes.axvline(each.since - 0.5, color="tab:gray", linestyle="--", linewidth=1, label=label)
    handles: tuple[Any, ...] = axes.get_legend_handles_labels()
    if evaluations:
        real = axes.twinx() if dreamt else axes
        episodes = f"{settings.evaluation_episodes} whole episodes"
        real.errorbar(
            [each.generation for each in evaluations], [each.mean for each in evaluations],
            [each.error for each in evaluations], fmt="o-" if dreamt else "o", color="tab:green", capsize=3,
            label=f"evaluated mean{' in reality' if dreamt else ''}, {episodes} (± standard error)",
        )  # fmt: skip
        _draw_confirmed(real, run)
        if dreamt:
            real.set_ylabel(f"score in reality, {episodes}", color="tab:green")
            handles = tuple(a + b for a, b in zip(handles, real.get_legend_handles_labels(), strict=True))
        else:
            handles = axes.get_legend_handles_labels()
    size = in_turn(f"{each.stage.population} candidates x {each.stage.episodes} episodes" for each in stages)
    horizon = in_turn(str(each.stage.horizon) for each in stages)
    axes.set(xlabel="generation", ylabel=f"fitness over {horizon} {'dreamt ' * dreamt}steps")
    title = f"{run.name}: {settings.task.task}, {size}, seed {settings.seed}"
    axes.set_title(title, fontsize=11)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    figure.legend(*handles, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _draw_confirmed(axes: Any, run: RunFolder) -> None:
    """The score that the run reports, which lies below its best evaluation where that was lucky."""
    if (confirmed := run.confirmation()) is not None:
        axes.errorbar(
            confirmed.generation, confirmed.mean, confirmed.error, fmt="*", color="tab:red", capsize=3, markersize=10,
            label=f"reported: confirmed on {confirmed.episodes} fresh tracks (± standard error)",
        )  # fmt: skip
