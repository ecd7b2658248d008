"""A new run that begins from another one: what it takes over, and what its own settings may change."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.stages import is_try
from dreamfleet.coordinator.settings.config import RunConfig, config_values
from dreamfleet.coordinator.settings.stage_tables import remaining_settings
from dreamfleet.coordinator.settings.start import (
    SUBSPACE_FACT,
    StartPoint,
    latest_mean_and_sigma,
    start_from_run,
    stored_subspace,
)


@dataclass(frozen=True)
class Fork:  # docs/how-to/stop-and-resume.md, docs/reference/optimisers.md
    """The settings that a run takes over from its source, and the mean that it begins at."""

    settings: dict[str, Any]
    start: StartPoint

    @classmethod
    def of(cls, runs_dir: Path, source: str, given: Collection[str]) -> Fork:
        """What a run takes over from the run `source`, which is only read; `given` are the settings of its own."""
        with open_run(runs_dir, source) as stored, stored.verified_transaction():
            if stored.settings.is_external:
                raise UsageError(
                    f"run {source} has no search of its own, and no mean to begin at: begin with --init CONTROLLER"
                )
            start, (_, sigma) = start_from_run(stored), latest_mean_and_sigma(stored)
            stage = stored.stage_at(len(stored.history())).stage
            if is_try(stored.settings.stages, stage.number) and "schedule" not in given:
                raise UsageError(
                    f"run {source} is in stage {stage.number}, one of several searches of which the best counts, and a "
                    "new run would know this one alone: continue it beyond the restarts, or give --schedule"
                )
            present = {
                **remaining_settings(stored.settings, stage),
                "sigma0": sigma,
                "temperature": stage.settings.task.temperature,
            }
            settings = {**config_values(stored.settings, stored.bundle_path), **present}
            if not stage.all_parameters:
                settings["loaded_subspace"] = stored_subspace(stored.fact(SUBSPACE_FACT), stored.settings, stored.path)
        if {"environment", "observation", "normalise"} & set(given):
            settings.pop("task_options", None)  # described anew, and refused if that makes another world of it
        if "optimiser" in given and "optimiser_options" not in given:
            settings.pop("optimiser_options", None)  # they are the other one's
        return cls(settings, start)

    def adapt(self, config: RunConfig) -> RunConfig:
        """The new run's configuration; the source's step size has no meaning in another subspace."""
        loaded_subspace, old = config.loaded_subspace, self.settings.get("loaded_subspace")
        if (loaded_subspace and loaded_subspace.sha256) == (old and old.sha256):
            return config
        stages = config.stages
        if config.sigma0 == self.settings["sigma0"] and not (stages and stages[0].sigma0):
            raise UsageError("another subspace than the run's makes a step something else: give --sigma0 too")
        if loaded_subspace is None and stages == self.settings["stages"]:  # inherited ones have nothing left to leave
            return replace(config, stages=tuple(replace(each, all_parameters=False) for each in stages))
        return config
