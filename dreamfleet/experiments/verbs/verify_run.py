"""`dreamfleet verify run`: re-run a run from its controller's provenance."""

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path

from dreamfleet.common.cli.config import add_flags
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.verbs.coordinator import ExitReport, build_request, serve_request
from dreamfleet.experiments.local.local_run import task_flags
from dreamfleet.experiments.rerun import Rerun

SUMMARY = (
    "re-run the run that a controller came from, by its provenance, and compare its reported controller bit by bit"
)
EXTRAS = ()
FIRST = "--run --bundle --optimiser --listen --connect --runs-dir --json"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("controller", metavar="CONTROLLER", help="a file, a run, or one that ships; it is only read")
    parser.add_argument(
        "--run", dest="run_name", metavar="NAME", help="the new run, or one to resume (default CONTROLLER-again)"
    )
    parser.add_argument("--optimiser", metavar="MODULE:ATTRIBUTE", help="the run's optimiser, if no installed one")
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)
    add_flags(parser, NetworkConfig)


def run(args: argparse.Namespace) -> int:
    """Serve the run for as many generations; exit 1 if it then reports another controller."""
    controller, beside = find_controller(args.controller, args.runs_dir)
    again = Rerun.of(controller, find_bundle_of(controller, args.bundle, beside))
    folder = args.runs_dir / check_run_name(args.run_name or f"{Path(args.controller).stem}-again")
    config, kept = again.plan(folder)
    if again.expected_difference:
        print(f"note: {again.expected_difference}", file=sys.stderr)
    worker = shlex.join(("dreamfleet", "worker", "--run", folder.name, *task_flags(controller.task)))
    print(f"note: workers score run {folder.name} as they scored the first; start some on this host or others: "
          f"{worker}", file=sys.stderr)  # fmt: skip
    request = build_request(args, folder.name, config, again.limits, kept, again.start if config else None)
    request = replace(request, again=shell_command(*args.typed))

    def on_ended() -> ExitReport:
        found = again.compare(folder)
        return ExitReport(f"; {found.summary}", {"same": found.same, "why": found.why}, 0 if found.same else 1)

    return serve_request(args, request, on_ended=on_ended)
