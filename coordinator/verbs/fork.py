"""`dreamfleet fork`: a new run that begins where another one stands."""

from __future__ import annotations

import argparse
import logging
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dreamfleet.common.errors import UsageError

if TYPE_CHECKING:
    from dreamfleet.coordinator.settings.config import RunConfig

log = logging.getLogger("dreamfleet.coordinator")
SUMMARY = "start a new run from another one's mean, step size, temperature and stage; other settings may change"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.coordinator.settings.run_setup import add_settings

    parser.add_argument("source", metavar="RUN", help="the run to begin from; it is only read")
    parser.add_argument("--run", dest="run_name", help="name of the new run (default RUN-fork)")
    add_settings(parser, default="RUN's own")


def run(args: argparse.Namespace) -> int:
    """Serve the new run until it ends."""
    from dreamfleet.common.runs.run_folder import open_run
    from dreamfleet.common.runs.scoring_params import scoring_params_of
    from dreamfleet.coordinator.settings.config import config_values
    from dreamfleet.coordinator.settings.schedule import remaining_settings
    from dreamfleet.coordinator.settings.start import (
        SUBSPACE_FACT,
        latest_mean_and_sigma,
        start_from_run,
        stored_subspace,
    )
    from dreamfleet.coordinator.verbs.coordinator import serve_new_run

    with open_run(args.runs_dir, args.source) as stored:
        start, (_, sigma), heat = start_from_run(stored), latest_mean_and_sigma(stored), stored.settings.heat
        scoring_params = scoring_params_of(stored, len(stored.history()))
        present = {
            **remaining_settings(stored.settings, scoring_params.stage),
            "sigma0": sigma,
            "temperature": scoring_params.spec.temperature,
        }
        settings = {**config_values(stored.settings, stored.bundle_path), **present}
        if not scoring_params.stage.whole:
            settings["loaded_subspace"] = stored_subspace(stored.fact(SUBSPACE_FACT), stored.settings, stored.path)
    if heat != 1.0:
        log.warning(
            "run %s raised its temperature by --heat %g, which is gone: the fork keeps its temperature",
            args.source,
            heat,
        )
    if {"environment", "normalise"} & args.given:
        settings.pop("task_options", None)  # described anew, and refused if that makes another world of it
    if "optimiser" in args.given and "optimiser_options" not in args.given:
        settings.pop("optimiser_options", None)  # they are the other one's
    args.run_name = args.run_name or f"{args.source}-fork"
    return serve_new_run(args, settings, start, lambda config: _adapt_to_subspace(config, settings, sigma))


def _adapt_to_subspace(config: RunConfig, before: dict[str, Any], sigma: float) -> RunConfig:
    """The fork's configuration; the source's `sigma` has no meaning in another subspace."""
    loaded_subspace, old = config.loaded_subspace, before.get("loaded_subspace")
    if (loaded_subspace and loaded_subspace.sha256) == (old and old.sha256):
        return config
    stages = config.stages
    if config.sigma0 == sigma and not (stages and stages[0].sigma0):
        raise UsageError("another subspace than the run's makes a step something else: give --sigma0 too")
    if loaded_subspace is None and stages == before["stages"]:  # inherited ones have nothing left to leave
        return replace(config, stages=tuple(replace(each, whole=False) for each in stages))
    return config
