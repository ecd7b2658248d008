"""How warm a run dreams: its temperature is raised each time that evaluations of its mean fall.

A generation's temperature is a pure function of the run's settings and of evaluations that are finished before it
opens, so that a life of the coordinator that is interrupted anywhere goes on to the bit.
"""

from __future__ import annotations

from collections.abc import Iterable

from dreamfleet.common.messages import HOTTEST, TaskSpec
from dreamfleet.common.runs import RunFolder, RunSettings, StoredEvaluation


def deciding_check(settings: RunSettings, generation: int) -> int:
    """The last evaluation, by its generation, that `generation`'s temperature depends on; negative: on none.

    It was scheduled at least `evaluate_every` generations earlier, which is the time that driving it may take.
    """
    every = settings.evaluate_every
    return -1 if settings.heat == 1 else (generation // every - 1) * every - 1


def raised_temperature(generation: int, settings: RunSettings, evaluations: Iterable[StoredEvaluation]) -> float | None:
    """The temperature that `generation` dreams at; `None` where it is the run's own.

    Each evaluation that lies clearly behind the best one since the last raise multiplies it by the run's heat, up to
    `HOTTEST`. Only evaluations that the schedule wants count: one that a limit called for depends on when a run was
    interrupted.
    """
    own = settings.task.temperature
    last = deciding_check(settings, generation)
    if own is None or last < 0:
        return None
    scheduled = range(settings.evaluate_every - 1, last + 1, settings.evaluate_every)
    counted = [each for each in evaluations if each.generation in scheduled]
    temperature = own
    best: StoredEvaluation | None = None
    for each in sorted(counted, key=lambda each: each.generation):
        if best is not None and each.behind(best):
            temperature, best = min(temperature * settings.heat, HOTTEST), None
        elif best is None or each.mean > best.mean:
            best = each
    return None if temperature == own else temperature


def spec_of(run: RunFolder, generation: int) -> TaskSpec:
    """What the candidates of a stored run's generation are scored in."""
    return run.spec.at(raised_temperature(generation, run.settings, run.evaluations()))
