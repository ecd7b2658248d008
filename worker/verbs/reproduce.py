"""`dreamfleet reproduce`: recorded scores again."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.cores import cores
from dreamfleet.common.errors import BundleError, ControllerError, UsageError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.site import offer
from dreamfleet.common.threads import pin_thread_pools

if TYPE_CHECKING:
    from dreamfleet.common.judgement import Judgement
    from dreamfleet.common.reproduction import Reproduction

SUMMARY = "drive recorded controllers again on their recorded seeds, and compare with what `evaluate --out` wrote"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("reports", metavar="REPORT", nargs="+", type=Path, help="files of `evaluate --out`")
    parser.add_argument("--episodes", type=int, help="drive only the first so many seeds of each (default all)")
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    parser.add_argument("--jobs", type=int, default=cores(), help="processes (default one a core)")
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Say of each report whether it holds; exit 1 if one does not."""
    pin_thread_pools()  # of NumPy, which is not loaded yet
    from dreamfleet.common.judgement import read_judgement

    if args.jobs < 1 or (args.episodes is not None and args.episodes < 1):
        raise UsageError("--episodes and --jobs must be at least 1")
    found = [_again(args, path, recorded) for path, recorded in [(each, read_judgement(each)) for each in args.reports]]
    rows = [{"report": path, **_row(each)} for path, each in zip(args.reports, found, strict=True)]
    holds = all(each.holds for each in found)
    answer(args, "\n".join(each.told for each in found), reproduced=holds, reports=rows)
    return 0 if holds else 1


def _again(args: argparse.Namespace, path: Path, recorded: Judgement) -> Reproduction:
    """Drive one report's controller again."""
    from dreamfleet.common.reproduction import Reproduction
    from dreamfleet.common.shelf import bundle_for, find_agent
    from dreamfleet.worker.scoring.agents import agent_of
    from dreamfleet.worker.verbs.evaluate import judge

    controller, beside = find_agent(recorded.name, args.runs_dir)
    if controller.sha256 != recorded.controller:
        raise ControllerError(
            f"{path} records the controller {recorded.controller[:12]}, and {recorded.name} is "
            f"{controller.sha256[:12]}: take the one that was recorded, or record this one with `dreamfleet evaluate`"
        )
    bundle = bundle_for(controller, args.bundle, beside)
    if bundle is not None and bundle.sha256 != recorded.bundle:
        raise BundleError(
            f"{path} records drives by the world model {recorded.bundle[:12] or 'of none'}, and this is "
            f"{bundle.sha256[:12]}: give that one by --bundle"
        )
    seeds = recorded.evaluated.seeds[: args.episodes]
    again = judge(recorded.name, agent_of(controller, bundle), seeds, args.jobs)
    return Reproduction(recorded, again)


def _row(found: Reproduction) -> dict[str, object]:
    difference = asdict(found.difference) if len(found.pairs) > 1 else None
    return {"name": found.recorded.name, "reproduced": found.holds, "same_host": found.same_host,
            "differing": found.differing, "mean": found.again.evaluated.mean, "difference": difference}  # fmt: skip
