"""`dreamfleet spawn|down`: workers on other hosts, over ssh."""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dreamfleet.common.cli.command_line import SimpleVerb
from dreamfleet.common.cli.config import add_flags, load
from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.cli.output import add_json_flag, print_rows
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import is_file, read_regular
from dreamfleet.common.printable import format_duration, printable
from dreamfleet.common.security.credentials import MAX_BYTES
from dreamfleet.coordinator.addons.spawn.config import HOSTS, Host, SpawnConfig, check_unique, default_name, read_hosts
from dreamfleet.coordinator.addons.spawn.parallel import bring_up, check, end
from dreamfleet.coordinator.addons.spawn.remote_host import FAILED, FleetAddress, HostStatus


def configure_spawn(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `spawn`."""
    _add_host_arguments(parser)
    parser.add_argument("--name", help="of host and worker, if only one is given (default its address without user)")
    add_global_flags(parser, "connect")
    parser.add_argument("--follow", action="store_true", help="show the workers' logs until Ctrl-C; they go on")
    parser.add_argument("--check", action="store_true", help="only look at each host, and change nothing there")
    add_flags(parser, SpawnConfig)
    add_json_flag(parser)


def start_workers(args: argparse.Namespace) -> int:
    """Start a worker on each host, or with `--check` look at it; exit 1 if a host failed."""
    if args.name is not None and (args.file or len(args.hosts) > 1):
        raise UsageError("--name is one worker's: for several hosts write a file with their names, for --hosts")
    hosts, fleet_address = _find_hosts(args, args.name), _fleet_address(args)
    if args.check:
        rows = check(hosts, fleet_address)
        _print_hosts(args, rows)
    else:

        def show(host: str, line: str) -> None:
            print(json.dumps({"host": host, "line": line}) if args.json else f"{host} | {printable(line)}", flush=True)

        rows = bring_up(hosts, fleet_address, lambda rows: _print_hosts(args, rows), show if args.follow else None)
    return _exit_code(rows)


def configure_down(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `down`."""
    _add_host_arguments(parser)
    parser.add_argument("--now", action="store_true", help="do not wait for what they score")
    parser.add_argument("--keep", action="store_true", help="leave environments and world models for the next time")
    add_flags(parser, SpawnConfig, only=("ssh", "remote_dir", "remote_python"))
    add_json_flag(parser)


def end_workers(args: argparse.Namespace) -> int:
    """End the workers; exit 1 if a host failed."""
    rows = end(_find_hosts(args), all_workers=args.file is None, now=args.now, keep=args.keep)
    _print_hosts(args, rows)
    return _exit_code(rows)


class _HostsFile(argparse.Action):
    """Takes the file of hosts as --config is taken: its top level and [spawn] hold for all hosts."""

    def __call__(self, _parser: Any, namespace: argparse.Namespace, values: Any, _flag: str | None = None) -> None:
        namespace.config = namespace.file = values


def _add_host_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("hosts", nargs="*", metavar="HOST", help="as ssh takes it: user@host, or ssh://user@host:port")
    parser.add_argument(
        "--hosts", dest="file", type=Path, metavar="FILE", action=_HostsFile,
        help="the hosts of this TOML file instead: a [[host]] table for each (docs/how-to/hosts.md)",
    )  # fmt: skip


def _find_hosts(args: argparse.Namespace, name: str | None = None) -> list[Host]:
    """The hosts of the file or of the command line; a single one's worker may have a `name`."""
    if args.file is not None:
        if args.config != args.file:
            raise UsageError("--hosts is a file of settings itself: omit --config")
        if args.hosts:
            raise UsageError("give the hosts of a file with --hosts, or hosts by their names, and not both")
        return read_hosts(args.sources["file"].get(HOSTS, []), args.sources)
    if files := [each for each in args.hosts if each.endswith(".toml") or is_file(Path(each))]:
        raise UsageError(f"{files[0]} is a file: give it as --hosts {files[0]}")
    spawn = load(SpawnConfig, "spawn", **args.sources)
    return check_unique([Host(name or default_name(each), each, spawn) for each in args.hosts])


def _fleet_address(args: argparse.Namespace) -> FleetAddress:
    """Endpoints that were given, a worker's join file for all hosts, or by default this host's own."""
    network, join = resolve_network(args, "worker"), args.global_config.join
    if join is None:
        return FleetAddress(network.connect)
    return FleetAddress(args.global_config.connect, read_regular(join, MAX_BYTES))


def _print_hosts(args: argparse.Namespace, rows: Sequence[HostStatus]) -> None:
    if args.json:
        print(json.dumps({"hosts": [asdict(each) for each in rows]}), flush=True)
        return
    shown = [{"host": each.host, "state": each.state, "slots": each.slots,
              "since": None if each.since is None else format_duration(each.since), "what": each.what}
             for each in rows]  # fmt: skip
    print_rows(shown, right=("slots", "since"))


def _exit_code(rows: Sequence[HostStatus]) -> int:
    return int(any(each.state == FAILED for each in rows))


SPAWN = SimpleVerb(
    "install and start a worker on other hosts over ssh, each with its join file; it goes on when ssh ends",
    configure_spawn,
    start_workers,
    FIRST="--hosts --name --connect --join --check --follow --slots --ssh --remote-python --json",
)
DOWN = SimpleVerb(
    "end the workers that spawn started, once they finish what they score, and remove them from their hosts",
    configure_down,
    end_workers,
)
