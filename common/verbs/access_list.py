"""`dreamfleet access list`: who was let in."""

from __future__ import annotations

import argparse
import json
from datetime import UTC, datetime

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_rows
from dreamfleet.common.security.certificate_ledger import LEDGER_FILE, CertificateLedger, IssuedJoinFile
from dreamfleet.common.security.credentials import describe_time_left

SUMMARY = "list the join files that were issued, with role, serial number and end"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_global_flags(parser, "access_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Print a line a file, the oldest first."""
    rows = [_row(each) for each in CertificateLedger.load(args.global_config.access_dir / LEDGER_FILE).issued]
    if args.json:
        print(json.dumps(rows, indent=2))
    else:
        print_rows(rows, drop_order=("serial",))
    return 0


def _row(each: IssuedJoinFile) -> dict[str, object]:
    state = "revoked" if each.revoked is not None else describe_time_left(each.expires_at - datetime.now(UTC))
    return {"name": each.name, "role": each.role, "identity": each.identity, "workers": _workers(each), "state": state,
            "expires": f"{each.expires_at:%Y-%m-%d %H:%M}", "serial": each.serial or None}  # fmt: skip


def _workers(each: IssuedJoinFile) -> str | None:
    """How status and story name whoever works with that file."""
    return f"*.{each.seat}" if each.role == "worker" else None
