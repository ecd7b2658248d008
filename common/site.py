"""The surroundings of every verb: where the fleet is reached, where runs live, how much is said.

In a TOML file these keys stand at the top, before any table; in the environment they are `DREAMFLEET_CONNECT` and the
like.
"""

from __future__ import annotations

import argparse
import difflib
import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from dreamfleet.common.config import add_flags, load, option, read_toml
from dreamfleet.common.errors import UsageError
from dreamfleet.common.logs import choose_format
from dreamfleet.common.network import DEFAULT_ENDPOINT, check_endpoint

ARRAYS = ("stage", "host")  # tables that a file may hold several of
# Of every verb: one file serves all of them.
TABLES = ("run", "limits", "network", "worker", "dashboard", "demo", "iterate", "router", "spawn")
OTHER_VARIABLES = ("DREAMFLEET_CACHE", "DREAMFLEET_CONFIG")
PREFIX = "DREAMFLEET_"
ALIKE = 0.75  # how near a name must be to a known one to be taken for a slip of the hand


@dataclass(frozen=True)
class SiteConfig:
    """What every verb may need; a verb offers as flags what it uses."""

    connect: tuple[str, ...] = option((), f"the run's router, or several to try (default {DEFAULT_ENDPOINT})")
    listen: tuple[str, ...] = option((), f"listen here (default {DEFAULT_ENDPOINT}, unless --connect is given)")
    runs_dir: Path = option(Path("runs"), "where runs live")  # noqa: RUF009 - a field, and paths do not change
    log_level: Literal["debug", "info", "warning", "error"] = option("info", "the least that is logged on stderr")
    log_format: Literal["text", "json", "auto"] = option("text", "as lines, as JSON, or auto: JSON but in a terminal")

    def __post_init__(self) -> None:
        for endpoint in (*self.connect, *self.listen):
            check_endpoint(endpoint)


def offer(parser: argparse.ArgumentParser, *names: str, texts: Mapping[str, str] | None = None) -> None:
    """Flags for some of the site's settings; `texts` says what is meant here where the common text does not fit."""
    add_flags(parser, SiteConfig, only=names, texts=texts)


def offer_everywhere(parser: argparse.ArgumentParser) -> None:
    """The flags that each verb has."""
    parser.add_argument("--config", type=Path, help="TOML file with settings (default $DREAMFLEET_CONFIG, else none)")
    offer(parser, "log_level", "log_format")
    parser.add_argument(
        "-q", "--quiet", dest="log_level", action="store_const", const="warning", default=argparse.SUPPRESS,
        help="log warnings and errors alone",
    )  # fmt: skip


def read_file(path: Path | None) -> dict[str, Any]:
    """A configuration file of any verb."""
    return read_toml(path, TABLES, top=[each.name for each in fields(SiteConfig)], arrays=ARRAYS)


def settle(args: argparse.Namespace, environment: Mapping[str, str] = os.environ) -> None:
    """Complete parsed arguments from the file and the environment, and set how much is logged.

    Afterwards `args` has every field of `SiteConfig`, `site` itself, `sources` for `config.load` of a verb's own
    sections, and `given`: the names that flags gave.
    """
    given = frozenset(vars(args))
    path = args.config or (Path(environment[f"{PREFIX}CONFIG"]) if environment.get(f"{PREFIX}CONFIG") else None)
    file = read_file(path)
    environment = _check_variables(environment)
    site = load(SiteConfig, "", flags=args, environment=environment, file=file)
    args.sources = {"flags": argparse.Namespace(**vars(args)), "environment": environment, "file": file}
    args.given, args.site = given, site
    args.connect, args.listen = site.connect or (DEFAULT_ENDPOINT,), site.listen
    args.runs_dir, args.log_level = site.runs_dir, site.log_level
    logging.getLogger("dreamfleet").setLevel(site.log_level.upper())
    choose_format(site.log_format)


def _check_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Our own variables; one that resembles a known one is refused, for it would be overlooked."""
    known = [PREFIX + each.name.upper() for each in fields(SiteConfig)]
    found = {name: text for name, text in environment.items() if name.startswith(PREFIX)}
    for name in found:
        short, shorts = name.removeprefix(PREFIX), [each.removeprefix(PREFIX) for each in (*known, *OTHER_VARIABLES)]
        if short in shorts or short.split("_")[0].lower() in TABLES:
            continue
        if near := difflib.get_close_matches(short, shorts, n=1, cutoff=ALIKE):
            raise UsageError(f"unknown environment variable {name}: did you mean {PREFIX}{near[0]}?")
    return found
