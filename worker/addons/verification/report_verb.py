"""`dreamfleet verify report`: check recorded scores."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.addons.evaluation_report import SIGHTS, EvaluationReport, read_evaluation_report
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import BundleError, ControllerError, UsageError
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.runs.lookup import find_bundle_of
from dreamfleet.worker.addons.evaluation.named_agents import find_agent, is_random, make_random_agent
from dreamfleet.worker.addons.verification.reproduction import Reproduction

if TYPE_CHECKING:
    from dreamfleet.worker.addons.evaluation.agents import Agent

SUMMARY = "drive recorded controllers again on their recorded seeds, and compare with what `evaluate --out` wrote"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("reports", metavar="REPORT", nargs="+", type=Path, help="files of `evaluate --out`")
    parser.add_argument("--episodes", type=int, help="only this many seeds of each, the first ones (default all)")
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="processes (default one per core)")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Check each report; exit 1 unless all are reproduced."""
    if args.jobs < 1 or (args.episodes is not None and args.episodes < 1):
        raise UsageError("--episodes and --jobs must be at least 1")
    recorded = [read_evaluation_report(each) for each in args.reports]
    rows, texts = list[dict[str, object]](), list[str]()
    for path, each in zip(args.reports, recorded, strict=True):
        found = list(_reproduce(args, path, each))
        texts += [one.description for one in found]
        own, *blind = map(_row, found)
        holds, sees = all(one.is_reproduced for one in found), None
        if each.asked_loss is not None and args.episodes is None:  # fewer seeds show less
            again = _join_passes(each, found)
            sees, was_seen = again.sees, each.sees
            holds = holds and (sees or not was_seen)
            texts.append(f"{each.name}: {'NOT reproduced: ' if was_seen > sees else ''}{again.describe_sight()}")
        rows.append({
            "report": path, **own, "reproduced": holds, "blind": blind, "asked_loss": each.asked_loss, "sees": sees,
        })  # fmt: skip
    reproduced = all(row["reproduced"] for row in rows)
    print_answer(args, "\n".join(texts), reproduced=reproduced, reports=rows)
    return 0 if reproduced else 1


def _reproduce(args: argparse.Namespace, path: Path, recorded: EvaluationReport) -> Iterator[Reproduction]:
    """Each pass of a report: with its own sight, then what was driven blind."""
    from dreamfleet.worker.addons.evaluation.agents import masked
    from dreamfleet.worker.addons.evaluation.evaluation import judge

    agent, note = _find_recorded_agent(args, path, recorded), partial(print, file=sys.stderr)
    blind = recorded.blind_passes
    passes = [("", agent, recorded), *((SIGHTS[each], masked(agent, each), found) for each, found in blind.items())]
    for how, driver, found in passes:
        if found.drives:
            again = judge(found.name, driver, found.results.seeds[: args.episodes], args.jobs, note, how)
            yield Reproduction(found, again)
        else:
            note(f"{found.name}: all episodes had failed: not driven again")


def _join_passes(recorded: EvaluationReport, found: Sequence[Reproduction]) -> EvaluationReport:
    """What was driven again, as one report."""
    own, *others = (each.repeated for each in found)
    driven = [sight for sight, each in recorded.blind_passes.items() if each.drives]
    blind: dict[str, Any] = {sight: each.drives for sight, each in zip(driven, others, strict=True)}
    return replace(own, asked_loss=recorded.asked_loss, **blind)


def _find_recorded_agent(args: argparse.Namespace, path: Path, recorded: EvaluationReport) -> Agent:
    from dreamfleet.worker.addons.evaluation.agents import make_agent

    if is_random(recorded.name, args.runs_dir):
        try:
            return make_random_agent(recorded.name, recorded.task, json.loads(recorded.options or "{}"))
        except UsageError as error:
            raise UsageError(f"{path}: {error}") from error
    controller, beside = find_agent(recorded.name, args.runs_dir)
    if controller.sha256 != recorded.controller:
        raise ControllerError(
            f"{path} records the controller {recorded.controller[:12]}, and {recorded.name} is "
            f"{controller.sha256[:12]}: take the one that was recorded, or record this one with `dreamfleet evaluate`"
        )
    bundle = find_bundle_of(controller, args.bundle, beside) if isinstance(controller, Controller) else None
    if bundle is not None and bundle.sha256 != recorded.bundle:
        raise BundleError(
            f"{path} records drives by the world model {recorded.bundle[:12] or 'of none'}, and this is "
            f"{bundle.sha256[:12]}: give that one by --bundle"
        )
    return make_agent(controller, bundle)


def _row(found: Reproduction) -> dict[str, object]:
    difference = asdict(found.difference) if len(found.pairs) > 1 else None
    return {
        "name": found.recorded.name,
        "reproduced": found.is_reproduced,
        "decided": found.is_decided,
        "same_host": found.same_fingerprint,
        "differing": found.differing_seeds,
        "differing_facts": found.differing_facts,
        "mean": found.repeated.results.mean,
        "difference": difference,
    }
