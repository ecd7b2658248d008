"""`dreamfleet spawn|up|down`: workers on other hosts, over ssh."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from dreamfleet.common.cli.command_line import SimpleVerb
from dreamfleet.common.cli.config import add_flags, load
from dreamfleet.common.cli.global_config import add_global_flags, read_config_file, resolve_network
from dreamfleet.common.cli.output import add_json_flag, print_rows
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import read_regular
from dreamfleet.common.monitoring.eta import format_duration
from dreamfleet.common.printable import one_line, printable
from dreamfleet.common.security.credentials import MAX_BYTES
from dreamfleet.coordinator.spawn.config import HOSTS, Host, SpawnConfig, check_unique, default_name, read_hosts
from dreamfleet.coordinator.spawn.parallel import bring_up, check, end
from dreamfleet.coordinator.spawn.remote_host import FAILED, FleetAddress, HostStatus


def configure_spawn(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `spawn`."""
    parser.add_argument("hosts", nargs="+", metavar="HOST", help="as ssh takes it: user@host, or ssh://user@host:port")
    parser.add_argument("--name", help="of host and worker, if only one is given (default its address without user)")
    _add_start_flags(parser)


def start_workers(args: argparse.Namespace) -> int:
    """Start a worker on each host that was named."""
    if args.name is not None and len(args.hosts) > 1:
        raise UsageError("--name is one worker's: for several hosts write a file, for `dreamfleet up`")
    spawn = load(SpawnConfig, "spawn", **args.sources)
    return _start(args, check_unique([Host(args.name or default_name(each), each, spawn) for each in args.hosts]))


def configure_up(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `up`."""
    parser.add_argument(  # read as --config is: its top level and [spawn] hold for all hosts
        "config", type=Path, metavar="FILE", help="TOML file with a [[host]] table for each (docs/how-to/hosts.md)"
    )
    _add_start_flags(parser)


def start_workers_of_file(args: argparse.Namespace) -> int:
    """Start a worker on each host of the file."""
    return _start(args, read_hosts(args.sources["file"].get(HOSTS, []), args.sources))


def configure_down(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `down`."""
    parser.add_argument(
        "hosts", nargs="+", metavar="FILE|HOST", help="the file of `up`: its workers; or hosts: every worker there"
    )
    parser.add_argument("--now", action="store_true", help="do not wait for what they score")
    parser.add_argument("--keep", action="store_true", help="leave environments and world models for the next time")
    add_flags(parser, SpawnConfig, only=("ssh", "remote_dir", "remote_python"))
    add_json_flag(parser)


def end_workers(args: argparse.Namespace) -> int:
    """End the workers; exit 1 if a host failed."""
    path = Path(args.hosts[0])
    of_file = len(args.hosts) == 1 and (path.suffix == ".toml" or path.is_file())
    if of_file:
        file = read_config_file(path)
        hosts = read_hosts(file.get(HOSTS, []), {**args.sources, "file": file})
    else:
        spawn = load(SpawnConfig, "spawn", **args.sources)
        hosts = check_unique([Host(default_name(each), each, spawn) for each in args.hosts])
    rows = end(hosts, all_workers=not of_file, now=args.now, keep=args.keep)
    _print_hosts(args, rows)
    return _exit_code(rows)


def _add_start_flags(parser: argparse.ArgumentParser) -> None:
    add_global_flags(parser, "connect")
    parser.add_argument("--follow", action="store_true", help="show the workers' logs until Ctrl-C; they go on")
    parser.add_argument("--check", action="store_true", help="only look at each host, and change nothing there")
    add_flags(parser, SpawnConfig)
    add_json_flag(parser)


def _start(args: argparse.Namespace, hosts: Sequence[Host]) -> int:
    """Start a worker on each host, or with `--check` look at it; exit 1 if a host failed."""
    fleet_address = _fleet_address(args)
    if args.check:
        rows = check(hosts, fleet_address)
        _print_hosts(args, rows)
    else:
        show = (lambda host, line: _print_log_line(args, host, line)) if args.follow else None
        rows = bring_up(hosts, fleet_address, lambda rows: _print_hosts(args, rows), show)
    return _exit_code(rows)


def _fleet_address(args: argparse.Namespace) -> FleetAddress:
    """Endpoints that were given, a worker's join file for all hosts, or by default this host's own."""
    network, join = resolve_network(args, "worker"), args.global_config.join
    if join is None:
        return FleetAddress(network.connect)
    return FleetAddress(args.global_config.connect, read_regular(join, MAX_BYTES))


def _print_hosts(args: argparse.Namespace, rows: Sequence[HostStatus]) -> None:
    if args.json:
        print(json.dumps({"hosts": [asdict(each) for each in rows]}), flush=True)
    else:
        print_rows([_table_row(each) for each in rows], right=("slots", "since"))


def _table_row(row: HostStatus) -> dict[str, object]:
    since = None if row.since is None else format_duration(row.since)
    return {"host": row.host, "state": row.state, "slots": row.slots, "since": since, "what": one_line(row.what)}


def _print_log_line(args: argparse.Namespace, host: str, line: str) -> None:
    print(json.dumps({"host": host, "line": line}) if args.json else f"{host} | {printable(line)}", flush=True)


def _exit_code(rows: Sequence[HostStatus]) -> int:
    return int(any(each.state == FAILED for each in rows))


SPAWN = SimpleVerb(
    "install and start a worker on other hosts over ssh; it gets its join file, and goes on when ssh ends",
    configure_spawn,
    start_workers,
)
UP = SimpleVerb(
    "start a worker on each host of a file, over ssh; a host whose worker runs is left alone",
    configure_up,
    start_workers_of_file,
)
DOWN = SimpleVerb(
    "end the workers that spawn and up started, once they finish what they score, and remove them from their hosts",
    configure_down,
    end_workers,
)
