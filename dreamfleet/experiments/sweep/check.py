"""Check every run of a sweep before anything starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.settings.config import DEFAULT_BUNDLE, RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.experiments.local_run import load_parsed_flags
from dreamfleet.experiments.sweep.plan import Sweep

# Flags of `coordinator` that a sweep sets for each run, or has for all of them.
OWN = (
    "run", "resume", "from", "listen", "connect", "runs-dir", "json", "config", "join", "access-dir", "insecure",
    "metrics-port",
)  # fmt: skip


def check_runs(sweep: Sweep, sources: Mapping[str, Any]) -> tuple[str, ...]:
    """The tasks that workers of the sweep score; `UsageError` if `coordinator` would refuse the settings of a run.

    `sources` are those of the verb, as `complete_arguments` left them.
    """
    from dreamfleet.common.cli.command_line import build_parser
    from dreamfleet.common.cli.config import load
    from dreamfleet.coordinator.settings import run_setup

    given = {*sweep.vary, *(flag.removeprefix("--").partition("=")[0] for flag in sweep.flags if flag[:2] == "--")}
    if taken := sorted(given & set(OWN)):
        raise UsageError(f"{taken[0]} is no setting that a sweep can give its runs: it sets it itself")
    parser = build_parser("coordinator", run_setup)
    tasks: dict[str, None] = {}
    checked: set[str] = set()
    for run in sweep.runs:
        try:
            parsed = parser.parse_all([*sweep.flags, *run.flags])
            config, limits = load_parsed_flags(parsed, sources)
            load(NetworkConfig, "network", **{**sources, "flags": parsed})
            if limits == LimitsConfig():
                raise UsageError("it would never end: give a limit, such as --generations 32")
            if run.setting not in checked:
                checked.add(run.setting)
                tasks |= dict.fromkeys(_check_settings(config, has_start=getattr(parsed, "init", None) is not None))
        except UsageError as error:
            raise UsageError(f"run {run.name} of the sweep: {error}") from error
    return tuple(tasks)


def _check_settings(config: RunConfig, *, has_start: bool) -> list[str]:
    """Check the settings together; return the tasks that they name."""
    bundle = None if config.needs_no_bundle else find_bundle(config.bundle or DEFAULT_BUNDLE)
    if not has_start:  # a start point may name another world model
        freeze(config, bundle)
    return [each for each in (config.task, bundle and bundle.manifest.task) if each]
