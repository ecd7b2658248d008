"""What a new run is and when it ends, from flags, environment and configuration file."""

from __future__ import annotations

import argparse
from dataclasses import replace

from dreamfleet.common.cli.config import Table, add_flags, load
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag
from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.settings.config import NO_SUBSPACE, LimitsConfig, NetworkConfig, RunConfig
from dreamfleet.coordinator.settings.presets import find_preset
from dreamfleet.coordinator.settings.schedule import find_schedule, split_first_stage

SUMMARY = "start a run: CMA-ES decides, workers score"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    name = parser.add_mutually_exclusive_group()
    name.add_argument("--run", dest="run_name", default="run", help="name of the new run (default run)")
    name.add_argument("--resume", metavar="RUN", help="continue this run from its journal, with the limits and the "
                      "network that it last had where no other are given")  # fmt: skip
    parser.add_argument(
        "--init",
        metavar="CONTROLLER",
        help="begin with these parameters instead of zeros: a file, a run, or what ships",
    )
    add_settings(parser)


def add_settings(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """The arguments of whatever serves a run; `default` is shown instead of the settings' defaults."""
    add_json_flag(parser)
    add_global_flags(parser, "runs_dir", "join", "access_dir")
    add_flags(parser, RunConfig, default=default)
    add_flags(parser, LimitsConfig, NetworkConfig)


def load_run_config(args: argparse.Namespace, base: Table) -> tuple[RunConfig, LimitsConfig]:
    """What a new run is, and when it ends, as its flags, the environment and the file say."""
    config = _with_subspace(_with_stages(args, load(RunConfig, "run", base=base, preset=find_preset, **args.sources)))
    limits = load(LimitsConfig, "limits", **args.sources)
    check_target(limits, config.evaluate_every)
    return config, limits


def _with_stages(args: argparse.Namespace, config: RunConfig) -> RunConfig:
    """The configuration with the stages that its schedule, or the configuration file, holds."""
    found = find_schedule(config.schedule, args.sources["file"])
    if found is None:
        return config
    twice = [name for name in split_first_stage(found)[0] if name in args.given]
    if twice:
        raise UsageError(f"--{twice[0]} and {twice[0]} of stage 1 are the same setting: leave one of them out")
    return replace(config, stages=found)


def _with_subspace(config: RunConfig) -> RunConfig:
    """The configuration with the subspace that it names."""
    from dreamfleet.common.runs.lookup import find_subspace

    if config.subspace is None:
        return config
    if not config.subspace:
        raise UsageError(f"--subspace is empty: name a file of `dreamfleet lab subspace`, or {NO_SUBSPACE}")
    return replace(config, loaded_subspace=None if config.subspace == NO_SUBSPACE else find_subspace(config.subspace))


def check_target(limits: LimitsConfig, evaluate_every: int) -> None:
    """`UsageError` for a target score where no mean is ever evaluated."""
    if limits.target is not None and not evaluate_every:
        raise UsageError("--target is reached by an evaluated mean: give --evaluate-every too")
