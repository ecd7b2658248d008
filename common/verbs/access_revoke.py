"""`dreamfleet access revoke`: whom the fleet lets in no more."""

from __future__ import annotations

import argparse

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.security.credentials import ROLES

SUMMARY = "take back all join files of a name"
EXTRAS = ("access",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("name", metavar="NAME", help="as it was issued")
    parser.add_argument("--role", choices=ROLES, help="needed where several roles have the name")
    add_global_flags(parser, "access_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Take them back, and say from when on that counts."""
    from dreamfleet.common.security.authority import Authority

    found = Authority(args.global_config.access_dir).revoke(args.name, args.role)
    role, who = found[0].role, found[0].identity
    soon = (
        "a coordinator with this --access-dir counts nothing of it from now on (2 s); "
        if role == "worker" else ""
    )  # fmt: skip
    text = f"{role} {args.name} ({who}) is revoked: {soon}routers let it do nothing from their next start on"
    print_answer(args, text, name=args.name, role=role, identity=who, files=len(found))
    return 0
