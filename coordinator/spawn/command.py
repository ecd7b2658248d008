"""What `spawn` and `up` have in common: flags, where workers connect, and the table of hosts."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict

from dreamfleet.common.config import add_flags
from dreamfleet.common.credentials import MOST_BYTES
from dreamfleet.common.eta import duration
from dreamfleet.common.files import read_regular
from dreamfleet.common.listing import add_json, print_rows
from dreamfleet.common.printable import one_line, printable
from dreamfleet.common.site import offer, reached
from dreamfleet.coordinator.spawn.config import Host, SpawnConfig
from dreamfleet.coordinator.spawn.many import bring_up, look
from dreamfleet.coordinator.spawn.visit import FAILED, Reach, Row


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the flags of a verb that brings workers up."""
    offer(parser, "connect")
    parser.add_argument("--follow", action="store_true", help="show the workers' logs until Ctrl-C; they go on")
    parser.add_argument("--check", action="store_true", help="look at each host alone, and change nothing there")
    add_flags(parser, SpawnConfig)
    add_json(parser)


def run(args: argparse.Namespace, hosts: Sequence[Host]) -> int:
    """Bring a worker up on each host, or look at it; exit 1 if one failed."""
    reach = _reach(args)
    if args.check:
        rows = look(hosts, reach)
        show_rows(args, rows)
    else:
        show = (lambda host, line: _show(args, host, line)) if args.follow else None
        rows = bring_up(hosts, reach, lambda rows: show_rows(args, rows), show)
    return exit_code(rows)


def _reach(args: argparse.Namespace) -> Reach:
    """Endpoints that were given, a worker's join file for all hosts, or by default this host's own."""
    network, join = reached(args, "worker"), args.site.join
    if join is None:
        return Reach(network.connect)
    return Reach(args.site.connect, read_regular(join, MOST_BYTES))


def show_rows(args: argparse.Namespace, rows: Sequence[Row]) -> None:
    """Print the table of all hosts."""
    if args.json:
        print(json.dumps({"hosts": [asdict(each) for each in rows]}), flush=True)  # noqa: T201 - the answer
    else:
        print_rows([_cells(each) for each in rows], right=("slots", "since"))


def exit_code(rows: Sequence[Row]) -> int:
    """1 if a host failed."""
    return int(any(each.state == FAILED for each in rows))


def _cells(row: Row) -> dict[str, object]:
    since = None if row.since is None else duration(row.since)
    return {"host": row.host, "state": row.state, "slots": row.slots, "since": since, "what": one_line(row.what)}


def _show(args: argparse.Namespace, host: str, line: str) -> None:
    text = json.dumps({"host": host, "line": line}) if args.json else f"{host} | {printable(line)}"
    print(text, flush=True)  # noqa: T201 - the answer
