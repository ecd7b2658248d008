"""`dreamfleet runs backup`: a second copy of a run, also of one that is being served."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.network import SECURED
from dreamfleet.common.runs import open_run
from dreamfleet.common.site import offer

SUMMARY = "copy a run, served or not, into another folder of runs, from which it can go on"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--to", type=Path, required=True, help="the other folder of runs, best on another disk")
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Copy, and look at the copy."""
    from dreamfleet.coordinator.backup import back_up
    from dreamfleet.coordinator.kept import again, kept_network

    target = args.to / args.run_name
    with open_run(args.runs_dir, args.run_name) as source:
        back_up(source, target)
    with open_run(args.to, args.run_name) as copy:
        generations, results = len(copy.history()), copy.result_count()
        network = kept_network(copy)
    secured = any(each.startswith(SECURED) for each in (*network.get("listen", ()), *network.get("connect", ())))
    join = args.site.join or ("FILE" if secured else None)
    text = (
        f"copied to {target}: {generations} closed generations, {results} results; should the run's own folder be "
        f"lost, go on with: {again(target, join)}"
    )
    answer(args, text, run=args.run_name, copy=target, generations=generations, results=results)
    return 0
