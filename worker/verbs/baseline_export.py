"""`dreamfleet baseline export`: what was trained, as a file that drives anywhere."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path

SUMMARY = "write a trained baseline as one file, which `evaluate --controller` and `record` take without torch"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.baselines.presets import NAMES

    parser.add_argument("agent", choices=NAMES, help="drqn; random drivers are none without their chance")
    parser.add_argument("--data", type=Path, required=True, help="the folder of its training")
    parser.add_argument("--out", type=Path, required=True, help="the file to write, NAME.zip")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Export and print the agent's identity."""
    from dreamfleet.worker.baselines.presets import DRQN

    if args.agent != DRQN:
        raise UsageError(f"{args.agent} learns nothing: there is nothing to export")
    check_output_path(args.out)
    from dreamfleet.worker.baselines.export import export_agent

    agent = export_agent(args.data)
    agent.save(args.out)
    made, size = agent.manifest.provenance, args.out.stat().st_size
    text = (
        f"{args.out}: {size / 1e6:.1f} MB, sha256 {agent.sha256}, after {made['episodes']} episodes, "
        f"{made['steps']:,} steps and {made['updates']:,} updates"
    )
    trained = {name: made[name] for name in ("episodes", "steps", "updates")}
    print_answer(args, text, agent=args.out, bytes=size, sha256=agent.sha256, **trained)
    return 0
