"""`dreamfleet up`: a worker on each host of a file, over ssh."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.coordinator.spawn import command
from dreamfleet.coordinator.spawn.config import HOSTS, read_hosts

SUMMARY = "start a worker on each host of a file, over ssh; those that run already are left"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(  # read as --config is: what stands at its top, and in [spawn], holds for all hosts
        "config", type=Path, metavar="FILE", help="TOML file with a [[host]] table for each (docs/hosts.md)"
    )
    command.configure(parser)


def run(args: argparse.Namespace) -> int:
    """Start them, and tell how they are."""
    return command.run(args, read_hosts(args.sources["file"].get(HOSTS, []), args.sources))
