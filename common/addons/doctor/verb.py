"""`dreamfleet doctor`: what is installed, what each role lacks, and how to install it."""

import argparse
import json
import platform
import sys

from dreamfleet.common.addons.doctor.health import ABSENT, ROLES, Finding, missing_for_role, run_checks
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_rows
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.printable import plural

SUMMARY = "check this installation: versions, fingerprint, what each role lacks and the remedy"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "--role", choices=ROLES, default="coordinator",
        help="exit 1 if this installation cannot play this role (default coordinator, which the others build on)",
    )  # fmt: skip
    parser.add_argument("--task", metavar="TASK", help="also check this task's environment, such as gym:LunarLander-v3")
    add_global_flags(parser, "runs_dir", "join")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Print the report; exit 1 if `--role` cannot be played."""
    findings = run_checks(args.runs_dir, args.global_config.join, args.task)
    roles = {role: missing_for_role(role, findings) for role in ROLES}
    host = {"python": platform.python_version(), "platform": platform.platform(), "cores": usable_cores(),
            "fingerprint": fingerprint()}  # fmt: skip
    if args.json:
        playable = {role: not lacks for role, lacks in roles.items()}
        checks = [vars(each) for each in findings]
        print(json.dumps({**host, "checks": checks, "roles": playable, "ok": playable[args.role]}, indent=2))
    else:
        print(f"Python {host['python']} at {sys.prefix}, {plural(usable_cores(), 'core')}, {host['platform']}")
        print(f"fingerprint: {host['fingerprint']}\n")
        print_rows([_row(each) for each in findings])
        print()
        print_rows([{"role": role, "here": _verdict(lacks)} for role, lacks in roles.items()])
    return 1 if roles[args.role] else 0


def _row(each: Finding) -> dict[str, object]:
    state = "ok" if each.ok else "missing" if each.found == ABSENT else "failed" if each.needed else "warning"
    return {"state": state, "check": each.name, "found": each.found, "for": each.role,
            "remedy": "" if each.ok else each.remedy}  # fmt: skip


def _verdict(lacks: list[Finding]) -> str:
    if not lacks:
        return "can be played"
    remedies = "; ".join(dict.fromkeys(each.remedy for each in lacks))
    return f"cannot be played: {', '.join(each.name for each in lacks)}; {remedies}"
