"""`dreamfleet access issue`: a join file."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.security.credentials import LISTENERS, ROLES
from dreamfleet.common.transport.network import SECURED_PREFIX, check_endpoint, check_secured

SUMMARY = "make a join file: one file, mode 600, with which a host is let into the fleet"
EXTRAS = ("access",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("role", choices=ROLES, help="what its holder may do: docs/security.md")
    parser.add_argument("name", metavar="NAME", help="of a host or person; who had it before keeps the seat")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the join file, which must not exist")
    add_global_flags(parser, "access_dir")
    parser.add_argument(
        "--connect", dest="endpoints", nargs="+", default=[], metavar="ENDPOINT",
        help="where the fleet is: tls/HOST:7447",
    )  # fmt: skip
    parser.add_argument(
        "--host", nargs="+", default=[], metavar="HOST",
        help="of a coordinator or router: names and addresses by which others reach it, beside localhost",
    )  # fmt: skip
    parser.add_argument("--days", type=float, help="how long it is good for (default: a worker's 30, others' 90)")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Make it."""
    from dreamfleet.common.security.authority import Authority

    for endpoint in args.endpoints:
        if not check_secured(check_endpoint(endpoint)).startswith(SECURED_PREFIX):
            raise UsageError(f"--connect {endpoint}: join files are for encrypted endpoints, such as tls/HOST:7447")
    if args.role not in LISTENERS and (args.host or not args.endpoints):
        raise UsageError(f"a {args.role} connects: give --connect tls/HOST:7447, and no --host")
    if args.role in LISTENERS and not args.host and not args.endpoints:
        raise UsageError(f"a {args.role} is reached by names: give --host, or --connect where a router listens for it")
    if args.days is not None and not 0 < args.days <= 3650:
        raise UsageError(f"--days must be above 0 and at most 3650, not {args.days:g}")
    who = Authority(args.global_config.access_dir).issue(
        args.role, args.name, args.out, connect=args.endpoints, hosts=args.host, days=args.days
    )
    called = f"; who works with it is called *.{who.seat}" if who.role == "worker" else ""
    text = (
        f"{args.out}: {who.role} {who.name} ({who.identity}) until {who.expires:%Y-%m-%d}; use it with --join, or "
        f"DREAMFLEET_JOIN{called}"
    )
    print_answer(
        args, text, out=args.out, role=who.role, name=who.name, identity=who.identity, expires=who.expires.isoformat()
    )
    return 0
