"""`dreamfleet spawn`: a worker on other hosts, over ssh."""

from __future__ import annotations

import argparse

from dreamfleet.common.cli.config import load
from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.spawn import command
from dreamfleet.coordinator.spawn.config import Host, SpawnConfig, check_unique, default_name

SUMMARY = "start a worker on other hosts over ssh: installed there, handed its join file, running on by itself"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("hosts", nargs="+", metavar="HOST", help="as ssh takes it: user@host, or ssh://user@host:port")
    parser.add_argument("--name", help="of host and worker, if it is one (default its address without user)")
    command.configure(parser)


def run(args: argparse.Namespace) -> int:
    """Start them, and tell how they are."""
    if args.name is not None and len(args.hosts) > 1:
        raise UsageError("--name is one worker's: for several hosts write a file, for `dreamfleet up`")
    spawn = load(SpawnConfig, "spawn", **args.sources)
    return command.run(args, check_unique([Host(args.name or default_name(each), each, spawn) for each in args.hosts]))
