"""`dreamfleet verify candidate`: recompute a stored fitness bit by bit."""

import argparse
import json
import math
import re
import sys
from dataclasses import replace
from statistics import fmean

import numpy as np

from dreamfleet.common.cli.config import load
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.common.printable import one_line, plural
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.worker.addons.verification.replay import ReplayedEpisode, replay
from dreamfleet.worker.service.config import WorkerConfig

SUMMARY = "score a run's candidate again and compare with the journal, bit by bit on a host of the same class"
EXTRAS = ("worker",)
TOLERANCE = 1e-6  # of the largest score: a mean's rounding is far smaller, a change that matters larger


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--candidate", required=True, metavar="G/I", help="generation and index, such as 3/0")
    parser.add_argument("--tolerance", type=float, metavar="N", help="by so much a fitness may differ that "
                        "a host of another class scored (default: it is not checked)")  # fmt: skip
    add_global_flags(parser, "runs_dir")
    parser.add_argument("--json", action="store_true", help="print the episodes as JSON")


def run(args: argparse.Namespace) -> int:
    """Replay each episode; exit 1 if one differs, or if this host can check none."""
    found = re.fullmatch(r"(\d{1,12})/(\d{1,12})", args.candidate)
    if not found:
        raise UsageError(f"--candidate {args.candidate!r}: write generation/index, such as 3/0")
    if args.tolerance is not None and not 0 <= args.tolerance < math.inf:
        raise UsageError(f"--tolerance must be 0 or more, not {args.tolerance}")
    with open_run(args.runs_dir, args.run_name) as stored:
        device = load(WorkerConfig, "worker", **args.sources).torch_device
        episodes = list(replay(stored, int(found[1]), int(found[2]), torch_device=device))
        stored_fitness, spec = stored.fitness(int(found[1]), int(found[2])), stored.spec
    scored = [each.stored for each in episodes if each.stored is not None]
    rounding = TOLERANCE * max(map(abs, scored), default=0.0)
    is_mean = stored_fitness is None or (bool(scored) and abs(fmean(scored) - stored_fitness) <= rounding)
    if not episodes:
        raise JournalError(f"candidate {args.candidate} of run {args.run_name} has no results yet")
    agree = [each.agrees(args.tolerance) for each in episodes]
    unchecked = agree.count(None)
    if args.json:
        same = is_mean and all(each.same for each in episodes)
        fitness = [each.replayed for each in episodes if each.replayed is not None]
        mean = float(np.mean(fitness)) if len(fitness) == len(episodes) else None
        rows = [{**vars(each), "failure": _text(each.failure), "error": _text(each.error)} for each in episodes]
        print(json.dumps({"identical": same, "unchecked": unchecked, "fitness": mean, "stored_fitness": stored_fitness,
                          "episodes": rows}))  # fmt: skip
    else:
        for each in episodes:
            print(f"episode {each.episode}  seed {each.seed}  {_describe(_in_values(each, spec), args.tolerance)}")
    count = plural(len(episodes), "episode")
    if varying := sum(not each.deterministic for each in episodes):
        print(f"{varying} of {count} {'was' if varying == 1 else 'were'} driven in an environment that is not "
              "deterministic, so replays are never bit-identical; --tolerance N compares them",
              file=sys.stderr)  # fmt: skip
    elif blocked := sum(not each.attempted for each in episodes):
        print(f"{blocked} of {count} crashed or hung the process, without a further drive",
              file=sys.stderr)  # fmt: skip
    elif unchecked:
        print(f"{unchecked} of {count} {'was' if unchecked == 1 else 'were'} scored by hosts of another class, which "
              "this host cannot check bit by bit; --tolerance N compares them", file=sys.stderr)  # fmt: skip
    if not is_mean:
        print("its fitness in the journal is not the mean of its results: the journal was changed", file=sys.stderr)
    return 0 if is_mean and False not in agree and True in agree else 1


def _in_values(each: ReplayedEpisode, task: TaskSpec) -> ReplayedEpisode:
    stored, replayed = (None if found is None else value_of(found, task) for found in (each.stored, each.replayed))
    return replace(each, stored=stored, replayed=replayed)


def _text(failure: Failure | None) -> str:
    return failure.text if failure else ""


def _describe(each: ReplayedEpisode, tolerance: float | None) -> str:
    if not each.failure and not each.error:
        return f"stored {each.stored!r}  replayed {each.replayed!r}  {_describe_match(each, tolerance)}"
    then = f"failed then ({one_line(each.failure.text)})" if each.failure else f"stored {each.stored!r}"
    if not each.attempted:
        return f"{then}  not driven again, as it would end or block its process"
    now = f"fails now ({one_line(each.error.text)})" if each.error else f"replayed {each.replayed!r}"
    return f"{then}  {now}  {'same cause' if each.same else _describe_match(each, tolerance)}"


def _describe_match(each: ReplayedEpisode, tolerance: float | None) -> str:
    if each.same:
        return "same bits"
    agrees = each.agrees(tolerance)
    if not each.deterministic:
        return f"another fitness, {'within' if agrees else 'outside'} {tolerance:g}" if agrees is not None else (
            "another fitness: the environment is not deterministic"
        )  # fmt: skip
    if agrees is None:
        return f"not checkable here: of class {each.host_class}"
    return f"within {tolerance:g}, of class {each.host_class}" if agrees else "DIFFERS"
