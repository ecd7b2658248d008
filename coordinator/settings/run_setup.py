"""What a new run is and when it ends, from flags, environment and configuration file. Pages: ask-tell.md."""

import argparse
from dataclasses import replace

from dreamfleet.common.cli.config import Table, add_flags, configurable_fields, load
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.tasks import DREAM, is_shipped
from dreamfleet.common.runs.records import EXTERNAL
from dreamfleet.coordinator.settings.config import NO_SUBSPACE, RunConfig
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.settings.presets import find_preset
from dreamfleet.coordinator.settings.stage_tables import find_schedule, split_first_stage

DEFAULT_NAME = "run"
SUMMARY = "start a run: CMA-ES decides, workers score"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "--run", dest="run_name", metavar="NAME",
        help=f"name of the new run: A-Z, a-z, 0-9, '_' and '-' (default {DEFAULT_NAME}, or RUN-fork with --from RUN)",
    )  # fmt: skip
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--resume", metavar="RUN", help="continue this run from its journal; its limits and network "
                     "are the last ones, unless flags give others")  # fmt: skip
    how.add_argument(
        "--from", dest="source", metavar="RUN",
        help="begin a new run where this one stands: with its mean, step size, temperature, stage and all settings, "
        "which flags may change; RUN is only read",
    )  # fmt: skip
    how.add_argument(
        "--init",
        metavar="CONTROLLER",
        help="begin a new run with this controller's parameters instead of zeros, and take over nothing else: a file, "
        "a run, or one that ships",
    )
    add_json_flag(parser)
    add_global_flags(parser, "runs_dir", "join", "access_dir")
    add_flags(parser, RunConfig)
    add_flags(parser, LimitsConfig, NetworkConfig)


def load_run_config(args: argparse.Namespace, base: Table) -> tuple[RunConfig, LimitsConfig]:
    """What a new run is, and when it ends, as its flags, the environment and the file say."""
    _check_tables(args.sources["file"] or {})
    config = _with_subspace(_with_stages(args, load(RunConfig, "run", base=base, preset=find_preset, **args.sources)))
    _check_effects(args, config)
    limits = load(LimitsConfig, "limits", **args.sources)
    check_limits(limits, config.evaluate_every, is_external=config.optimiser == EXTERNAL)
    return config, limits


def _check_tables(file: Table) -> None:
    """`UsageError` for a key of [limits] in [run], or one of [run] in [limits]."""
    own = {"run": RunConfig, "limits": LimitsConfig}
    keys = {name: {each.name for each in configurable_fields(section)} for name, section in own.items()}
    for name, other in (("run", "limits"), ("limits", "run")):
        if misplaced := [key for key in file.get(name, ()) if key in keys[other] - keys[name]]:
            raise UsageError(f"unknown key {misplaced[0]!r} in [{name}]: write it in [{other}]")


def _with_stages(args: argparse.Namespace, config: RunConfig) -> RunConfig:
    found = find_schedule(config.schedule, args.sources["file"])
    if found is None:
        return config
    twice = [name for name in split_first_stage(found)[0] if name in args.given]
    if twice:
        raise UsageError(f"--{twice[0]} and {twice[0]} of stage 1 are the same setting: omit one of them")
    return replace(config, stages=found)


def _check_effects(args: argparse.Namespace, config: RunConfig) -> None:
    """`UsageError` for a flag that changes nothing beside the run's other settings; a file may serve many runs."""
    dreams = config.task == DREAM or (config.task is not None and not is_shipped(config.task))
    needs = {
        "temperature": (dreams, f"--task {DREAM}"),
        "features": ("features" not in args.given or not config.needs_no_bundle, "a world model"),
        "collect_episodes": (config.collect_every, "--collect-every"),
    }
    for name, (has_effect, needed) in needs.items():
        if name in args.given and not has_effect:
            raise UsageError(f"--{name.replace('_', '-')} changes nothing without {needed}: give that, or omit this")


def _with_subspace(config: RunConfig) -> RunConfig:
    from dreamfleet.common.runs.lookup import find_subspace

    if config.subspace is None:
        return config
    if not config.subspace:
        raise UsageError(f"--subspace is empty: name a file of `dreamfleet lab subspace`, or {NO_SUBSPACE}")
    return replace(config, loaded_subspace=None if config.subspace == NO_SUBSPACE else find_subspace(config.subspace))


def check_limits(limits: LimitsConfig, evaluate_every: int, *, is_external: bool) -> None:
    """`UsageError` for a limit by evaluated means where none is ever evaluated, and for any of an external run."""
    if is_external and limits != LimitsConfig():
        raise UsageError(
            f"a run with --optimiser {EXTERNAL} has no limits: it waits for batches until `dreamfleet stop`, so leave "
            "--generations, --steps, --minutes, --target and --parted out"
        )
    if (limits.target is not None or limits.parted) and not evaluate_every:
        flag = "--parted" if limits.target is None else "--target"
        raise UsageError(f"{flag} is reached by evaluated means: give --evaluate-every too")
