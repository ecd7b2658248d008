"""`dreamfleet access list`: who was let in."""

from __future__ import annotations

import argparse
import json
from datetime import UTC, datetime

from dreamfleet.common.credentials import told_left
from dreamfleet.common.ledger import ISSUED, Issued, Ledger
from dreamfleet.common.listing import add_json, print_rows
from dreamfleet.common.site import offer

SUMMARY = "list the join files that were issued, with role, serial number and end"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    offer(parser, "access_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print a line a file, the oldest first."""
    rows = [_row(each) for each in Ledger.load(args.site.access_dir / ISSUED).issued]
    if args.json:
        print(json.dumps(rows, indent=2))
    else:
        print_rows(rows, least_first=("serial",))
    return 0


def _row(each: Issued) -> dict[str, object]:
    state = "revoked" if each.revoked is not None else told_left(each.when - datetime.now(UTC))
    return {"name": each.name, "role": each.role, "identity": each.identity, "workers": _workers(each), "state": state,
            "expires": f"{each.when:%Y-%m-%d %H:%M}", "serial": each.serial or None}  # fmt: skip


def _workers(each: Issued) -> str | None:
    """How status and story name whoever works with that file."""
    return f"*.{each.seat}" if each.role == "worker" else None
