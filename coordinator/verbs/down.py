"""`dreamfleet down`: end the workers that `spawn` and `up` brought to hosts, and leave nothing there."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.cli.config import add_flags, load
from dreamfleet.common.cli.global_config import read_config_file
from dreamfleet.common.cli.output import add_json_flag
from dreamfleet.coordinator.spawn import parallel
from dreamfleet.coordinator.spawn.command import exit_code, show_rows
from dreamfleet.coordinator.spawn.config import HOSTS, Host, SpawnConfig, check_unique, default_name, read_hosts

SUMMARY = "end the workers that spawn and up started: they finish what runs, and nothing of them is left there"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "hosts", nargs="+", metavar="FILE|HOST", help="the file of `up`: its workers; or hosts: every worker there"
    )
    parser.add_argument("--now", action="store_true", help="do not wait for what they score")
    parser.add_argument("--keep", action="store_true", help="leave environments and world models for the next time")
    add_flags(parser, SpawnConfig, only=("ssh", "remote_dir", "remote_python"))
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """End them; exit 1 where that failed."""
    path = Path(args.hosts[0])
    of_file = len(args.hosts) == 1 and (path.suffix == ".toml" or path.is_file())
    if of_file:
        file = read_config_file(path)
        hosts = read_hosts(file.get(HOSTS, []), {**args.sources, "file": file})
    else:
        spawn = load(SpawnConfig, "spawn", **args.sources)
        hosts = check_unique([Host(default_name(each), each, spawn) for each in args.hosts])
    rows = parallel.end(hosts, all_workers=not of_file, now=args.now, keep=args.keep)
    show_rows(args, rows)
    return exit_code(rows)
