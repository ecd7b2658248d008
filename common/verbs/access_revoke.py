"""`dreamfleet access revoke`: whom the fleet lets in no more."""

from __future__ import annotations

import argparse

from dreamfleet.common.credentials import ROLES
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.site import offer

SUMMARY = "take back all join files of a name"
EXTRAS = ("access",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("name", metavar="NAME", help="as it was issued")
    parser.add_argument("--role", choices=ROLES, help="needed where several roles have the name")
    offer(parser, "access_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Take them back, and say from when on that counts."""
    from dreamfleet.common.authority import Authority

    found = Authority(args.site.access_dir).revoke(args.name, args.role)
    role, who = found[0].role, found[0].identity
    soon = (
        "a coordinator with this --access-dir counts nothing of it from now on (2 s); "
        if role == "worker" else ""
    )  # fmt: skip
    text = f"{role} {args.name} ({who}) is revoked: {soon}routers let it do nothing from their next start on"
    answer(args, text, name=args.name, role=role, identity=who, files=len(found))
    return 0
