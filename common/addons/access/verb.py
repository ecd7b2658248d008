"""`dreamfleet access init|issue|list|revoke`: a fleet's authority, and the join files that let hosts in."""

import argparse
import json
from datetime import UTC, datetime
from pathlib import Path

from dreamfleet.common.cli.command_line import SimpleVerb
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_rows
from dreamfleet.common.errors import UsageError
from dreamfleet.common.security.certificate_ledger import CHECK_INTERVAL, LEDGER_FILE, CertificateLedger, IssuedJoinFile
from dreamfleet.common.security.credentials import LISTENERS, ROLES, describe_time_left
from dreamfleet.common.transport.network import SECURED_PREFIX, check_endpoint, check_secured


def configure_init(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `access init`."""
    text = "the folder to make (default access); its holder decides who joins the fleet"
    add_global_flags(parser, "access_dir", texts={"access_dir": text})
    parser.add_argument(
        "--passwords", action="store_true",
        help="let hosts join by passwords derived from one secret, instead of by certificates",
    )  # fmt: skip
    add_json_flag(parser)


def init_authority(args: argparse.Namespace) -> int:
    """Make an authority."""
    from dreamfleet.common.addons.access.authority import Authority

    folder = args.global_config.access_dir
    Authority.create(folder, passwords=args.passwords)
    text = (
        f"{folder}: keep it on this host, and a copy where only you read it; next: dreamfleet access issue coordinator "
        "NAME --host HOST --out FILE"
    )
    print_answer(args, text, access_dir=folder, passwords=args.passwords)
    return 0


def configure_issue(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `access issue`."""
    parser.add_argument("role", choices=ROLES, help="what its holder may do: docs/how-to/security.md")
    parser.add_argument(
        "name", metavar="NAME", help="of a host or person; a name that was issued before keeps its seat"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the join file, which must not exist")
    add_global_flags(parser, "access_dir")
    parser.add_argument(
        "--connect", dest="endpoints", nargs="+", default=[], metavar="ENDPOINT",
        help="where the fleet is: tls/HOST:7447",
    )  # fmt: skip
    parser.add_argument(
        "--host", nargs="+", default=[], metavar="HOST",
        help="names and addresses, beside localhost, by which others reach this coordinator or router",
    )  # fmt: skip
    parser.add_argument("--days", type=float, help="how long it is valid (default: 30 for a worker, 90 for others)")
    add_json_flag(parser)


def issue_join_file(args: argparse.Namespace) -> int:
    """Write a join file."""
    from dreamfleet.common.addons.access.authority import AUTHORITY_DAYS, Authority

    for endpoint in args.endpoints:
        if not check_secured(check_endpoint(endpoint)).startswith(SECURED_PREFIX):
            raise UsageError(f"--connect {endpoint}: join files are for encrypted endpoints, such as tls/HOST:7447")
    if args.role not in LISTENERS and (args.host or not args.endpoints):
        raise UsageError(f"a {args.role} connects: give --connect tls/HOST:7447, and no --host")
    if args.role in LISTENERS and not args.host and not args.endpoints:
        raise UsageError(f"a {args.role} is reached by names: give --host, or --connect where a router listens for it")
    if args.days is not None and not 0.001 <= args.days <= AUTHORITY_DAYS:
        raise UsageError(f"--days must be from 0.001 to {AUTHORITY_DAYS}, not {args.days:g}")
    issued = Authority(args.global_config.access_dir).issue(
        args.role, args.name, args.out, connect=args.endpoints, hosts=args.host, days=args.days
    )
    workers = f"; its workers are named *.{issued.seat}" if issued.role == "worker" else ""
    text = (
        f"{args.out}: {issued.role} {issued.name} ({issued.identity}) until {issued.expires:%Y-%m-%d}; use it with "
        f"--join, or DREAMFLEET_JOIN{workers}"
    )
    print_answer(
        args, text, out=args.out, role=issued.role, name=issued.name, identity=issued.identity,
        expires=issued.expires.isoformat(),
    )  # fmt: skip
    return 0


def configure_list(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `access list`."""
    add_global_flags(parser, "access_dir")
    add_json_flag(parser)


def list_join_files(args: argparse.Namespace) -> int:
    """Print one row per join file, the oldest first."""
    rows = [_row(each) for each in CertificateLedger.load(args.global_config.access_dir / LEDGER_FILE).issued]
    if args.json:
        print(json.dumps(rows, indent=2))
    else:
        print_rows(rows, drop_order=("serial",))
    return 0


def _row(each: IssuedJoinFile) -> dict[str, object]:
    state = "revoked" if each.revoked is not None else describe_time_left(each.expires_at - datetime.now(UTC))
    workers = f"*.{each.seat}" if each.role == "worker" else None  # as status and story name its workers
    return {"name": each.name, "role": each.role, "identity": each.identity, "workers": workers, "state": state,
            "expires": f"{each.expires_at:%Y-%m-%d %H:%M}", "serial": each.serial or None}  # fmt: skip


def configure_revoke(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `access revoke`."""
    parser.add_argument("name", metavar="NAME", help="as it was issued")
    parser.add_argument("--role", choices=ROLES, help="needed where several roles have the name")
    add_global_flags(parser, "access_dir")
    add_json_flag(parser)


def revoke_join_files(args: argparse.Namespace) -> int:
    """Revoke a name's join files, and print from when on that holds."""
    from dreamfleet.common.addons.access.authority import Authority

    authority = Authority(args.global_config.access_dir)
    found = authority.revoke(args.name, args.role)
    role, identity = found[0].role, found[0].identity
    soon = ""
    if role == "worker":
        soon = f"a coordinator with this --access-dir counts nothing of it from now on ({CHECK_INTERVAL:g} s); "
    text = f"{role} {args.name} ({identity}) is revoked: {soon}routers let it do nothing from their next start on"
    if gives_all := authority.uses_passwords and role in LISTENERS:
        text += ". Its file gives all passwords of the fleet: if another has it, make another authority"
    elif role in LISTENERS:
        text += (
            ". Clients and workers do not check it: if others can answer at its address with it, make another authority"
        )
    print_answer(args, text, name=args.name, role=role, identity=identity, files=len(found), gives_all=gives_all)
    return 0


INIT = SimpleVerb(
    "make an authority, whose join files let hosts into a fleet, each in its role, over TLS",
    configure_init,
    init_authority,
    EXTRAS=("access",),
)
ISSUE = SimpleVerb(
    "make a join file: one file, mode 600, with which a host joins the fleet",
    configure_issue,
    issue_join_file,
    EXTRAS=("access",),
)
LIST = SimpleVerb(
    "list the join files that were issued, with role, serial number and end", configure_list, list_join_files
)
REVOKE = SimpleVerb("revoke all join files of a name", configure_revoke, revoke_join_files, EXTRAS=("access",))
