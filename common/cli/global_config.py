"""Settings that all verbs share: addresses of the fleet, the folder of runs, logging.

In a TOML file these keys come first, before any table; in the environment they are `DREAMFLEET_CONNECT` and so on.
"""

import argparse
import logging
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from dreamfleet.common.cli.config import add_flags, load, option, read_toml
from dreamfleet.common.errors import AccessError, UsageError
from dreamfleet.common.host.logs import set_log_format
from dreamfleet.common.host.trusted_modules import PLACES, trust
from dreamfleet.common.printable import suggest
from dreamfleet.common.protocol.tasks import module_of
from dreamfleet.common.security.credentials import (
    EXPIRY_WARNING,
    Credentials,
    describe_time_left,
    issue_command,
    read_join_file,
)
from dreamfleet.common.transport.network import DEFAULT_ENDPOINT, SECURED_LOOPBACK, Network, check_endpoint

log = logging.getLogger(__name__)
ARRAYS = ("stage", "host")  # arrays of tables
# The tables of every verb: all verbs may share one file.
TABLES = ("run", "limits", "network", "worker", "dashboard", "serve", "demo", "iterate", "router", "spawn", "vae",
          "mdnrnn", "baseline")  # fmt: skip
OTHER_VARIABLES = ("DREAMFLEET_CACHE", "DREAMFLEET_CONFIG", "DREAMFLEET_PICTURES", PLACES)
PREFIX = "DREAMFLEET_"
SIMILARITY_CUTOFF = 0.88  # similarity to a known name from which an unknown variable counts as a typing error


@dataclass(frozen=True)
class GlobalConfig:
    """The shared settings; each verb has flags for those that it uses."""

    connect: tuple[str, ...] = option((), f"the run's router, or several to try (default {DEFAULT_ENDPOINT})")
    listen: tuple[str, ...] = option((), f"listen here (default {DEFAULT_ENDPOINT}, unless --connect is given)")
    join: Path | None = option(  # noqa: RUF009 - as below
        None, "join file of `dreamfleet access issue`: the fleet's address and this program's credentials for TLS"
    )
    access_dir: Path = option(  # noqa: RUF009 - as below
        Path("access"), "folder of the fleet's certificate authority and its list of revoked files"
    )
    runs_dir: Path = option(Path("runs"), "where runs live")  # noqa: RUF009 - a field, and paths do not change
    trust: tuple[str, ...] = option(
        (), "modules of tasks and optimisers that may be imported although only a file or another host names them"
    )
    log_level: Literal["debug", "info", "warning", "error"] = option("info", "lowest level that is logged on stderr")
    log_format: Literal["text", "json", "auto"] = option("text", "text, json, or auto: text in a terminal, else JSON")

    def __post_init__(self) -> None:
        for endpoint in (*self.connect, *self.listen):
            check_endpoint(endpoint)


def add_global_flags(parser: argparse.ArgumentParser, *names: str, texts: Mapping[str, str] | None = None) -> None:
    """Add flags for these shared settings, and `--join` with `connect`; `texts` replaces help texts by name."""
    add_flags(parser, GlobalConfig, only=(*names, *(("join",) if "connect" in names else ())), texts=texts)


def add_run_argument(parser: argparse.ArgumentParser) -> None:
    """Add `args.run_name`, the live run that a verb acts on: as `RUN` or as `--run RUN`."""
    text = "name of the run (default: the only live one)"
    parser.add_argument("run_name", nargs="?", metavar="RUN", default=argparse.SUPPRESS, help=text)
    parser.add_argument("--run", dest="run_name", metavar="RUN", help="the same")


def add_common_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that every verb has."""
    parser.add_argument("--config", type=Path, help="TOML file with settings (default $DREAMFLEET_CONFIG, else none)")
    add_global_flags(parser, "log_level", "log_format", "trust")
    parser.add_argument(
        "-q", "--quiet", dest="log_level", action="store_const", const="warning", default=argparse.SUPPRESS,
        help="log only warnings and errors, and draw no progress bar",
    )  # fmt: skip


def read_config_file(path: Path | None) -> dict[str, Any]:
    """Read a configuration file; it may hold the settings of any verb."""
    return read_toml(path, TABLES, top=[each.name for each in fields(GlobalConfig)], arrays=ARRAYS)


def complete_arguments(args: argparse.Namespace, environment: Mapping[str, str] = os.environ) -> None:
    """Complete a command's arguments as in `read_arguments`, and configure logging."""
    read_arguments(args, environment)
    logging.getLogger("dreamfleet").setLevel(args.log_level.upper())
    set_log_format(args.global_config.log_format)


def read_arguments(args: argparse.Namespace, environment: Mapping[str, str] = os.environ) -> None:
    """Complete parsed arguments from the file and the environment, and trust the modules that they name.

    Sets `args.global_config` (`resolve_network` adds default addresses), `args.sources` for `config.load` of the verb's
    own sections, and `args.given`, the names of the flags on the command line.
    """
    given = frozenset(vars(args))
    path = args.config or (Path(environment[f"{PREFIX}CONFIG"]) if environment.get(f"{PREFIX}CONFIG") else None)
    file = read_config_file(path)
    environment = _check_variables(environment)
    global_config = load(GlobalConfig, "", flags=args, environment=environment, file=file)
    args.sources = {"flags": argparse.Namespace(**vars(args)), "environment": environment, "file": file}
    args.given, args.global_config = given, global_config
    args.listen, args.runs_dir, args.log_level = global_config.listen, global_config.runs_dir, global_config.log_level
    trust((*global_config.trust, *_named_modules(args, environment, file)))


def _named_modules(args: argparse.Namespace, environment: Mapping[str, str], file: Mapping[str, Any]) -> list[str]:
    """The modules of the tasks and optimisers that the user names by a flag, a variable or the configuration file."""
    names: list[object] = []
    for setting in ("task", "optimiser"):  # docs/how-to/trust.md says which
        given = getattr(args, setting, ())
        names += given if isinstance(given, list) else [given]
        names += [environment.get(f"{PREFIX}RUN_{setting.upper()}"), file.get("run", {}).get(setting)]
    return [module_of(name) for name in names if isinstance(name, str)]


def load_credentials(args: argparse.Namespace, roles: Collection[str] = ()) -> Credentials | None:
    """Read and check the join file, if one is set; `AccessError` if its role is not among `roles` (empty: any role)."""
    from dreamfleet.common.security.handshake import check_certificate

    path: Path | None = args.global_config.join
    if path is None:
        return None
    credentials = read_join_file(path)
    if roles and credentials.role not in roles:
        raise AccessError(
            f"{path} is for the role {credentials.role}, and this needs {' or '.join(roles)}: have it issued "
            f"with `{issue_command(next(iter(roles)), 'NAME')}`"
        )
    check_certificate(credentials)
    left = credentials.time_left
    if left < EXPIRY_WARNING:
        log.warning("%s expires soon (%s): have %s %s issued again", path, describe_time_left(left), credentials.role,
                    credentials.name)  # fmt: skip
    return credentials


def resolve_network(args: argparse.Namespace, *roles: str) -> Network:
    """The fleet's address and this program's credentials; the join file's address if none is configured."""
    credentials = load_credentials(args, roles)
    own = (DEFAULT_ENDPOINT,) if credentials is None else credentials.connect or (SECURED_LOOPBACK,)
    return Network(connect=args.global_config.connect or own, credentials=credentials)


def _check_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables that begin with `PREFIX`; `UsageError` for an unknown one that resembles a known one."""
    known = [*(PREFIX + each.name.upper() for each in fields(GlobalConfig)), *OTHER_VARIABLES]
    found = {name: text for name, text in environment.items() if name.startswith(PREFIX)}
    for name in found:
        if name in known or name.removeprefix(PREFIX).split("_")[0].lower() in TABLES:
            continue
        if near := suggest(name, known, likeness=SIMILARITY_CUTOFF, listed=False):
            raise UsageError(f"unknown environment variable {name}{near}")
    return found
