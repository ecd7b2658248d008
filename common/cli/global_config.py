"""The surroundings of every verb: where the fleet is reached, where runs live, how much is said.

In a TOML file these keys stand at the top, before any table; in the environment they are `DREAMFLEET_CONNECT` and the
like.
"""

from __future__ import annotations

import argparse
import difflib
import logging
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from dreamfleet.common.cli.config import add_flags, load, option, read_toml
from dreamfleet.common.errors import AccessError, UsageError
from dreamfleet.common.host.logs import set_log_format
from dreamfleet.common.security.credentials import EXPIRY_WARNING, Credentials, describe_time_left, read_join_file
from dreamfleet.common.transport.network import DEFAULT_ENDPOINT, Network, check_endpoint

log = logging.getLogger(__name__)
ARRAYS = ("stage", "host")  # tables that a file may hold several of
# Of every verb: one file serves all of them.
TABLES = ("run", "limits", "network", "worker", "dashboard", "demo", "iterate", "router", "spawn")
OTHER_VARIABLES = ("DREAMFLEET_CACHE", "DREAMFLEET_CONFIG")
PREFIX = "DREAMFLEET_"
SIMILARITY_CUTOFF = 0.75  # how near a name must be to a known one to be taken for a slip of the hand


@dataclass(frozen=True)
class GlobalConfig:
    """What every verb may need; a verb offers as flags what it uses."""

    connect: tuple[str, ...] = option((), f"the run's router, or several to try (default {DEFAULT_ENDPOINT})")
    listen: tuple[str, ...] = option((), f"listen here (default {DEFAULT_ENDPOINT}, unless --connect is given)")
    join: Path | None = option(  # noqa: RUF009 - as below
        None, "join file of `dreamfleet access issue`: where the fleet is, and as whom this joins it, over TLS"
    )
    access_dir: Path = option(Path("access"), "where the fleet's own authority lies, and what it revoked")  # noqa: RUF009
    runs_dir: Path = option(Path("runs"), "where runs live")  # noqa: RUF009 - a field, and paths do not change
    log_level: Literal["debug", "info", "warning", "error"] = option("info", "the least that is logged on stderr")
    log_format: Literal["text", "json", "auto"] = option("text", "as lines, as JSON, or auto: JSON but in a terminal")

    def __post_init__(self) -> None:
        for endpoint in (*self.connect, *self.listen):
            check_endpoint(endpoint)


def add_global_flags(parser: argparse.ArgumentParser, *names: str, texts: Mapping[str, str] | None = None) -> None:
    """Flags for some of the site's settings; `texts` says what is meant here where the common text does not fit.

    Whatever connects may do so with a join file.
    """
    add_flags(parser, GlobalConfig, only=(*names, *(("join",) if "connect" in names else ())), texts=texts)


def add_run_argument(parser: argparse.ArgumentParser) -> None:
    """The live run that a verb is about, `args.run_name`: by its name alone, or behind `--run`."""
    told = "name of the run (default: the only live one)"
    parser.add_argument("run_name", nargs="?", metavar="RUN", default=argparse.SUPPRESS, help=told)
    parser.add_argument("--run", dest="run_name", metavar="RUN", help="the same")


def add_common_flags(parser: argparse.ArgumentParser) -> None:
    """The flags that each verb has."""
    parser.add_argument("--config", type=Path, help="TOML file with settings (default $DREAMFLEET_CONFIG, else none)")
    add_global_flags(parser, "log_level", "log_format")
    parser.add_argument(
        "-q", "--quiet", dest="log_level", action="store_const", const="warning", default=argparse.SUPPRESS,
        help="log warnings and errors alone, and draw no progress bar",
    )  # fmt: skip


def read_config_file(path: Path | None) -> dict[str, Any]:
    """A configuration file of any verb."""
    return read_toml(path, TABLES, top=[each.name for each in fields(GlobalConfig)], arrays=ARRAYS)


def complete_arguments(args: argparse.Namespace, environment: Mapping[str, str] = os.environ) -> None:
    """Complete parsed arguments from the file and the environment, and set how much is logged.

    Afterwards `args` has `global_config` (`resolve_network` fills in the default addresses of the fleet), `sources` for
    `config.load` of a verb's own sections, and `given`: the names of the flags that were given.
    """
    given = frozenset(vars(args))
    path = args.config or (Path(environment[f"{PREFIX}CONFIG"]) if environment.get(f"{PREFIX}CONFIG") else None)
    file = read_config_file(path)
    environment = _check_variables(environment)
    global_config = load(GlobalConfig, "", flags=args, environment=environment, file=file)
    args.sources = {"flags": argparse.Namespace(**vars(args)), "environment": environment, "file": file}
    args.given, args.global_config = given, global_config
    args.listen, args.runs_dir, args.log_level = global_config.listen, global_config.runs_dir, global_config.log_level
    logging.getLogger("dreamfleet").setLevel(global_config.log_level.upper())
    set_log_format(global_config.log_format)


def load_credentials(args: argparse.Namespace, roles: Collection[str] = ()) -> Credentials | None:
    """What the join file holds, if there is one; `AccessError` if it is of none of the `roles` that this verb needs."""
    path: Path | None = args.global_config.join
    if path is None:
        return None
    credentials = read_join_file(path)
    if roles and credentials.role not in roles:
        raise AccessError(
            f"{path} is a {credentials.role}'s, and this needs one whose role is {' or '.join(roles)}: have it issued "
            f"with `dreamfleet access issue {next(iter(roles))} NAME --out FILE`"
        )
    left = credentials.time_left(datetime.now(UTC))
    if left < EXPIRY_WARNING:
        log.warning("%s expires soon (%s): have %s %s issued again", path, describe_time_left(left), credentials.role,
                    credentials.name)  # fmt: skip
    return credentials


def resolve_network(args: argparse.Namespace, *roles: str) -> Network:
    """Where the fleet is found, and as whom: where flags, environment or file say, else where the join file does."""
    credentials = load_credentials(args, roles)
    found = credentials.connect if credentials is not None else ()
    return Network(connect=args.global_config.connect or found or (DEFAULT_ENDPOINT,), credentials=credentials)


def _check_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Our own variables; one that resembles a known one is refused, for it would be overlooked."""
    known = [PREFIX + each.name.upper() for each in fields(GlobalConfig)]
    found = {name: text for name, text in environment.items() if name.startswith(PREFIX)}
    for name in found:
        short, shorts = name.removeprefix(PREFIX), [each.removeprefix(PREFIX) for each in (*known, *OTHER_VARIABLES)]
        if short in shorts or short.split("_")[0].lower() in TABLES:
            continue
        if near := difflib.get_close_matches(short, shorts, n=1, cutoff=SIMILARITY_CUTOFF):
            raise UsageError(f"unknown environment variable {name}: did you mean {PREFIX}{near[0]}?")
    return found
