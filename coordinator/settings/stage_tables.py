"""A schedule as it is given: stages in a file of their own, or as `[[stage]]` in a configuration file."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dreamfleet.common.cli.config import Table, read_table, read_toml
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.runs.records import MAX_STAGES, RunSettings, StageSettings
from dreamfleet.common.runs.stages import Stage, stages_of

STAGE, NO_SCHEDULE = "stage", "none"


def find_schedule(name: str | None, file: Table) -> tuple[StageSettings, ...] | None:
    """The stages in the file of this name, else those of the configuration `file`; `None`: neither has any."""
    if name == NO_SCHEDULE:
        return ()
    if name is not None:
        return read_stages(read_toml(Path(name), (), arrays=(STAGE,), kind="schedule").get(STAGE, ()), name)
    return read_stages(file[STAGE], "the configuration file") if STAGE in file else None


def read_stages(tables: Sequence[Table], where: str) -> tuple[StageSettings, ...]:
    """A schedule from its tables; `UsageError` for what none can be, whatever the run."""
    if not 1 <= len(tables) <= MAX_STAGES:
        raise UsageError(
            f"{where} holds {len(tables)} stages, and a schedule has 1 to {MAX_STAGES}: write each as [[stage]]"
        )
    return tuple(_read_stage(number, table) for number, table in enumerate(tables, 1))


def _read_stage(number: int, table: Table) -> StageSettings:
    name = f"stage {number}"
    values = read_table(StageSettings, name, table)
    for key in ("generations", "steps"):
        if not 1 <= values.get(key, 1) < 2**63:
            raise UsageError(f"{name}: {key} must be from 1 to {2**63 - 1}, not {values[key]}")
    if not math.isfinite(values.get("score", 0)):
        raise UsageError(f"{name}: score must be a number, not {values['score']}")
    return StageSettings(**values)


def split_first_stage(stages: tuple[StageSettings, ...]) -> tuple[dict[str, Any], tuple[StageSettings, ...]]:
    """What the first stage names, which are the run's own settings, and the schedule without that."""
    if not stages:
        return {}, ()
    first = stages[0]
    if first.restart:
        raise UsageError("stage 1: restart is for a later stage, which searches anew where the run began; omit it")
    if first.all_parameters:
        raise UsageError("stage 1: all_parameters is for a later stage, to leave the subspace; omit --subspace instead")
    return first.overrides, (first.end, *stages[1:]) if first.has_end or len(stages) > 1 else ()


def remaining_settings(settings: RunSettings, stage: Stage) -> dict[str, Any]:
    """The settings of a run that begins with this stage of another, counted anew, and goes on as that would."""
    stages = (stage.end, *settings.stages[stage.number :]) if stage.number < len(settings.stages) else ()
    return {**stage.values, "stages": stages}


def check_schedule(settings: RunSettings) -> None:
    """`UsageError` for a stage that never ends before the last one, or by what can never be reached."""
    stages = stages_of(settings)
    for before, stage, each in zip(stages, stages[1:], settings.stages[1:], strict=False):
        if stage.restart and before.end.score is None:
            raise UsageError(
                f"stage {stage.number} is a restart, which is left out once a score is reached: give stage "
                f"{before.number} a score, and steps or generations"
            )
        if each.restart and (each.all_parameters or each.overrides):
            named = ", ".join([*each.overrides, *["all_parameters"] * each.all_parameters])
            raise UsageError(
                f"stage {stage.number} is a restart, which searches as stage {before.number} does and may be left out: "
                f"omit {named}"
            )
        if each.all_parameters and before.all_parameters:
            raise UsageError(f"stage {stage.number}: it searches all parameters already; omit that, or give --subspace")
        if each.all_parameters and each.sigma0 is None:
            raise UsageError(
                f"stage {stage.number} leaves the subspace, where a step is something else: give it a sigma0"
            )
    for stage in stages[:-1]:
        if not stage.end.has_end:
            raise UsageError(
                f"stage {stage.number} never ends, and stage {stage.number + 1} would never begin: give it "
                "generations, steps or a score"
            )
        _check_end(stage, settings.evaluate_every)
    if stages[-1].restart:
        raise UsageError(f"stage {stages[-1].number} is the last and a restart: add a stage that begins at its mean")
    if stages[-1].end.has_end:
        raise UsageError(
            f"stage {stages[-1].number} is the last and names an end: omit it there; the run itself ends by "
            "--generations, --steps and the like"
        )


def _check_end(stage: Stage, every: int) -> None:
    end, name = stage.end, f"stage {stage.number}"
    if end.score is not None and not every:
        raise UsageError(f"{name} ends by the score of an evaluated mean: give --evaluate-every too")
    if end.score is not None and 0 < end.generations <= every:
        raise UsageError(
            f"{name} never ends by its score: an evaluation counts {plural(every, 'generation')} later "
            f"(--evaluate-every), and it has {end.generations}: give it more, or omit the score"
        )
    own = stage.settings
    most = end.generations * own.population * own.episodes * own.task.horizon
    if end.generations and end.steps > most:
        raise UsageError(
            f"{name} never ends by its steps: {plural(end.generations, 'generation')} have {most} at most; omit "
            "one of the two"
        )
