"""Run flags of another verb, parsed as `coordinator` parses them, before hours of other work go by."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.settings.config import LimitsConfig, RunConfig

RESERVED: dict[str, str | None] = {
    "run_name": "run",
    "resume": None,
    "init": None,
}  # of each run, beside the next line's
RESERVED |= dict.fromkeys(("bundle", "seed", "runs_dir", "listen", "connect", "config", "subspace"))


def parse_run_flags(flags: Sequence[str], sources: Mapping[str, Any], verb: str) -> tuple[RunConfig, LimitsConfig]:
    """What a run is, and when it ends, as its flags, the environment and the file say.

    `sources` are those of `verb`, as `complete_arguments` left them. `UsageError` for flags that `verb` gives itself,
    for wrong ones, and where none sets a limit.
    """
    from dreamfleet.common.cli.command_line import build_parser
    from dreamfleet.coordinator.settings import run_setup

    told = build_parser("coordinator", run_setup).parse_all(list(flags))
    if taken := [name for name, default in RESERVED.items() if getattr(told, name, default) != default]:
        names = ", ".join(f"--{name.replace('_name', '').replace('_', '-')}" for name in taken)
        raise UsageError(f"{names} in --run-flags: each run has its own, and --config is a flag of {verb}")
    heard = argparse.Namespace(sources={**sources, "flags": told}, given=frozenset(vars(told)))
    config, limits = run_setup.load_run_config(heard, base={})
    if limits == LimitsConfig():
        raise UsageError("a run would never end: give --run-flags a limit, such as --generations 32")
    return config, limits
