"""`dreamfleet runs backup`: a second copy of a run, also of one that is being served."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import resume_command
from dreamfleet.common.transport.network import SECURED_PREFIX

SUMMARY = "copy a run, served or not, into another folder of runs, from which it can go on"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--to", type=Path, required=True, help="the other folder of runs, best on another disk")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Copy, and look at the copy."""
    from dreamfleet.coordinator.settings.resume_settings import stored_network
    from dreamfleet.coordinator.storage.backup import back_up

    target = args.to / args.run_name
    with open_run(args.runs_dir, args.run_name) as source:
        back_up(source, target)
    with open_run(args.to, args.run_name) as copy:
        generations, results = len(copy.history()), copy.result_count()
        network = stored_network(copy)
    secured = any(each.startswith(SECURED_PREFIX) for each in (*network.get("listen", ()), *network.get("connect", ())))
    join = args.global_config.join or ("FILE" if secured else None)
    text = (
        f"copied to {target}: {generations} closed generations, {results} results; should the run's own folder be "
        f"lost, go on with: {resume_command(target, join)}"
    )
    print_answer(args, text, run=args.run_name, copy=target, generations=generations, results=results)
    return 0
