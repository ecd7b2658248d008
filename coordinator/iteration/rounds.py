"""What a run is that another verb begins: read as `coordinator` reads it, before hours of other work go by."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.config import LimitsConfig, RunConfig

OURS: dict[str, str | None] = {"run_name": "run", "resume": None, "init": None}  # of each run, beside the next line's
OURS |= dict.fromkeys(("bundle", "seed", "runs_dir", "listen", "connect", "config", "subspace"))


def run_of(flags: Sequence[str], sources: Mapping[str, Any], whose: str) -> tuple[RunConfig, LimitsConfig]:
    """What a run is, and when it ends, as its flags, the environment and the file say.

    `sources` are the verb's own, as `settle` left them. `UsageError` for flags that are `whose` to give, that are
    wrong, or that name no limit.
    """
    from dreamfleet.common.cli import parser_of
    from dreamfleet.coordinator.verbs import coordinator

    told = parser_of("coordinator", coordinator).parse_all(list(flags))
    if taken := [name for name, default in OURS.items() if getattr(told, name, default) != default]:
        names = ", ".join(f"--{name.replace('_name', '').replace('_', '-')}" for name in taken)
        raise UsageError(f"{names} in --run-flags: each run has its own, and --config is a flag of {whose}")
    heard = argparse.Namespace(sources={**sources, "flags": told}, given=frozenset(vars(told)))
    config, limits = coordinator.configured(heard, base={})
    if limits == LimitsConfig():
        raise UsageError("a run would never end: give --run-flags a limit, such as --generations 32")
    return config, limits
