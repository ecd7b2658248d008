"""`dreamfleet evaluate`: a controller on unseen seeds."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.addons.analysis.run_archive import find_elite
from dreamfleet.common.addons.evaluation_report import SIGHTS, check_seed_range
from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.cli.key_values import ENVIRONMENT_EXAMPLE, parse_arguments
from dreamfleet.common.cli.output import print_next
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path, open_output
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.stop_signals import interrupted_by_signals
from dreamfleet.common.protocol.result_bounds import LARGEST_FITNESS
from dreamfleet.common.runs.lookup import find_bundle_of
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.worker.addons.evaluation.named_agents import find_driver, is_random
from dreamfleet.worker.service.bundle_fetch import fetch_bundle_of

if TYPE_CHECKING:
    from dreamfleet.worker.addons.evaluation.agents import Agent

SUMMARY = "judge a controller on unseen seeds, in whole episodes of the world itself"
EXTRAS = ("worker",)
FIRST = "--controller --run --task --connect --episodes --first-seed --bundle --jobs --out --json"
ELSEWHERE = {"--tracks": "give --episodes N, the number of tracks"}
CONTROLLER = (
    "who drives: the file of a controller or agent, a training's folder, a run, one that ships, or random: uniform "
    "random actions in --task (random-discrete: the default world's five)"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--controller", help=CONTROLLER)
    add_random_flags(parser)
    parser.add_argument(
        "--run", dest="run_name", metavar="RUN", help="judge this live run's reported controller instead"
    )
    add_global_flags(
        parser, "connect", texts={"connect": "ask the live run here (give --run too where there are several)"}
    )
    parser.add_argument("--episodes", type=int, default=100, help="whole episodes, one per seed (default 100)")
    parser.add_argument("--first-seed", type=int, default=TEST.start, help=f"the first seed (default {TEST.start})")
    parser.add_argument(
        "--cell",
        help="judge the elite of this cell of the run's archive: its numbers, such as 3,7, or MEASURE=VALUE,...",
    )
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="processes (default one per core)")
    parser.add_argument(
        "--blind", nargs="?", metavar="LOSS", type=float, const=True,
        help="drive the same episodes twice more: what decides is painted out, then another episode's painted in; "
        "LOSS: exit 1 unless the mean loses that much by each, significantly",
    )  # fmt: skip
    add_global_flags(parser, "runs_dir")
    parser.add_argument("--json", action="store_true", help="print every figure and drive as JSON")
    parser.add_argument(
        "--out", type=Path, help="also write that JSON to this file, for `compare`, `verify report` and `card`; "
        "`runs show` reads evaluation.json in the run's folder",
    )  # fmt: skip


def add_random_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the world in which random actions are drawn."""
    parser.add_argument(
        "--task", metavar="TASK",
        help=f"of --controller random: the world, a task without a world model, such as gym:ENVIRONMENT (default "
        f"{FIRST_WORLD})",
    )  # fmt: skip
    parser.add_argument(
        "--environment", nargs="+", default=[], metavar="KEY=VALUE",
        help="of --controller random: arguments of its task, as a run's --environment",
    )  # fmt: skip


def named_agent(args: argparse.Namespace) -> Agent:
    """The agent of `--controller`; a note on stderr names the world of random actions."""
    arguments = parse_arguments("--environment", args.environment, ENVIRONMENT_EXAMPLE)
    options = {"environment": arguments} if arguments else {}
    agent = find_driver(args.controller, args.runs_dir, args.bundle, args.task, options)
    if is_random(args.controller, args.runs_dir):
        remedy = "" if args.task else "; --task names another world"
        print(f"{args.controller} actions in {agent.reality}{remedy}", file=sys.stderr)
    return agent


def agent_flags(args: argparse.Namespace) -> tuple[object, ...]:
    """The flags of the same agent for `evaluate` and `record`."""
    runs_dir = args.runs_dir if "runs_dir" in getattr(args, "given", ()) else None
    values = {"controller": args.controller, "bundle": args.bundle, "task": args.task, "runs-dir": runs_dir}
    found = (word for name, value in values.items() if value is not None for word in (f"--{name}", value))
    return (*found, *(("--environment", *args.environment) if args.environment else ()))


def run(args: argparse.Namespace) -> int:
    """Drive, and print the scores."""
    from dreamfleet.worker.addons.evaluation.evaluation import judge_in_passes

    if args.episodes < 1 or args.first_seed < 0 or args.jobs < 1:
        raise UsageError("--episodes and --jobs must be at least 1, --first-seed at least 0")
    check_seed_range(args.first_seed, args.episodes)
    asked = None if args.blind is True else args.blind
    if asked is not None and not 0 <= asked <= LARGEST_FITNESS:
        raise UsageError(f"--blind {asked:g}: a loss is from 0 to {LARGEST_FITNESS:g}")
    if args.out:
        check_output_path(args.out)
    name, agent = _choose_agent(args)
    seeds = tuple(range(args.first_seed, args.first_seed + args.episodes))
    note = partial(print, file=sys.stderr)
    if seeds[0] not in TEST or seeds[-1] not in TEST:
        some = "some" if seeds[0] < TEST.stop and seeds[-1] >= TEST.start else "none"
        note(f"note: test seeds are {TEST.start} to {TEST.stop - 1}; {some} of these are among them")
    sights, found = ({} if args.blind is None else SIGHTS), None
    try:
        with interrupted_by_signals():
            for each in judge_in_passes(name, agent, seeds, args.jobs, note, sights):
                found = replace(each, asked_loss=asked)
    finally:  # a blind pass that is interrupted or fails takes nothing from those before
        if found is not None:
            if missing := [how for sight, how in sights.items() if sight not in found.blind_passes]:
                note(f"missing below, as not driven to the end: {', '.join(missing)}")
            print(found.to_json() if args.json else found.describe(agent.world.score_word), flush=True)
            if args.out:
                with open_output(args.out) as file:
                    file.write(f"{found.to_json()}\n".encode())
    if args.controller and args.cell is None:  # a live run's controller, and a cell's, are no file here
        print_next(args, ("record", *agent_flags(args)))
    return 0 if asked is None or (found is not None and found.sees) else 1


def _choose_agent(args: argparse.Namespace) -> tuple[str, Agent]:
    from dreamfleet.worker.addons.evaluation.agents import make_agent

    live = bool(args.run_name) or bool({"connect", "join"} & args.given)
    if (args.task or args.environment) and (not args.controller or args.cell is not None):
        raise UsageError("--task and --environment are the world of --controller random: a run has its own")
    if live and not args.controller:
        with Client(resolve_network(args)) as client:
            run = args.run_name or client.status().run
            reported = client.controller(run)
            if args.bundle is None:
                return run, make_agent(reported, fetch_bundle_of(reported, client.session, run))
        return run, make_agent(reported, find_bundle_of(reported, args.bundle))
    if live or not args.controller:
        raise UsageError("give either --controller, or --run (and --connect) to judge what a live run reports")
    if args.cell is not None:
        controller, beside, found = find_elite(args.runs_dir, args.controller, args.cell)
        name = f"{args.controller}, cell {args.cell}"
        print(f"{args.controller}, {found}, as the run measured it", file=sys.stderr)
        return name, make_agent(controller, find_bundle_of(controller, args.bundle, beside))
    return args.controller, named_agent(args)
