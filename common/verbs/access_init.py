"""`dreamfleet access init`: an authority of this fleet's own."""

from __future__ import annotations

import argparse

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer

SUMMARY = "make an authority, whose join files let hosts into a fleet, each in its role, over TLS"
EXTRAS = ("access",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_global_flags(
        parser,
        "access_dir",
        texts={"access_dir": "the folder to make (default access); it lets in whom its holder likes"},
    )
    parser.add_argument(
        "--passwords", action="store_true",
        help="the fleet is joined by passwords that follow from a secret, rather than by certificates",
    )  # fmt: skip
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Make it."""
    from dreamfleet.common.security.authority import Authority

    folder = args.global_config.access_dir
    Authority.create(folder, passwords=args.passwords)
    text = (
        f"{folder}: keep it on this host, and a copy where only you read it; next: dreamfleet access issue coordinator "
        "NAME --host HOST --out FILE"
    )
    print_answer(args, text, access_dir=folder, passwords=args.passwords)
    return 0
