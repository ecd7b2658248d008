"""What `spawn` and `up` have in common: flags, where workers connect, and the table of hosts."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict

from dreamfleet.common.cli.config import add_flags
from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.cli.output import add_json_flag, print_rows
from dreamfleet.common.files.regular_files import read_regular
from dreamfleet.common.monitoring.eta import format_duration
from dreamfleet.common.printable import one_line, printable
from dreamfleet.common.security.credentials import MAX_BYTES
from dreamfleet.coordinator.spawn.config import Host, SpawnConfig
from dreamfleet.coordinator.spawn.parallel import bring_up, check
from dreamfleet.coordinator.spawn.remote_host import FAILED, FleetAddress, HostStatus


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the flags of a verb that brings workers up."""
    add_global_flags(parser, "connect")
    parser.add_argument("--follow", action="store_true", help="show the workers' logs until Ctrl-C; they go on")
    parser.add_argument("--check", action="store_true", help="look at each host alone, and change nothing there")
    add_flags(parser, SpawnConfig)
    add_json_flag(parser)


def run(args: argparse.Namespace, hosts: Sequence[Host]) -> int:
    """Bring a worker up on each host, or look at it; exit 1 if one failed."""
    fleet_address = _fleet_address(args)
    if args.check:
        rows = check(hosts, fleet_address)
        show_rows(args, rows)
    else:
        show = (lambda host, line: _print_log_line(args, host, line)) if args.follow else None
        rows = bring_up(hosts, fleet_address, lambda rows: show_rows(args, rows), show)
    return exit_code(rows)


def _fleet_address(args: argparse.Namespace) -> FleetAddress:
    """Endpoints that were given, a worker's join file for all hosts, or by default this host's own."""
    network, join = resolve_network(args, "worker"), args.global_config.join
    if join is None:
        return FleetAddress(network.connect)
    return FleetAddress(args.global_config.connect, read_regular(join, MAX_BYTES))


def show_rows(args: argparse.Namespace, rows: Sequence[HostStatus]) -> None:
    """Print the table of all hosts."""
    if args.json:
        print(json.dumps({"hosts": [asdict(each) for each in rows]}), flush=True)  # noqa: T201 - the answer
    else:
        print_rows([_table_row(each) for each in rows], right=("slots", "since"))


def exit_code(rows: Sequence[HostStatus]) -> int:
    """1 if a host failed."""
    return int(any(each.state == FAILED for each in rows))


def _table_row(row: HostStatus) -> dict[str, object]:
    since = None if row.since is None else format_duration(row.since)
    return {"host": row.host, "state": row.state, "slots": row.slots, "since": since, "what": one_line(row.what)}


def _print_log_line(args: argparse.Namespace, host: str, line: str) -> None:
    text = json.dumps({"host": host, "line": line}) if args.json else f"{host} | {printable(line)}"
    print(text, flush=True)  # noqa: T201 - the answer
