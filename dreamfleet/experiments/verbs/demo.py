"""`dreamfleet demo`: everything on this machine, in minutes."""

import argparse
import os
from datetime import datetime

from dreamfleet.common.cli.config import add_flags, load
from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.errors import StoppedError
from dreamfleet.common.host.packages import check_modules
from dreamfleet.common.host.stop_signals import interrupted_by_signals
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.experiments.demo import Demo, DemoConfig

SUMMARY = "evolve a controller on this machine in minutes, judge it, plot it and record its drive"
EXTRAS = ("worker", "views")
FIRST = "--world --run --dream-minutes --minutes --population --episodes --tracks --seed --workers --page"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--run", dest="run_name", metavar="NAME", help="name of the run (default: demo and the time)")
    add_global_flags(parser, "runs_dir")
    add_flags(parser, DemoConfig)


@interrupted_by_signals()
def run(args: argparse.Namespace) -> int:
    """Play the demonstration."""
    config = load(DemoConfig, "demo", **args.sources)
    check_modules(("av", "gymnasium", "matplotlib", "onnxruntime", *config.plan.packages))
    os.environ["DREAMFLEET_JOIN"] = ""  # the demo stays on this host, even if its user is in a fleet
    name = check_run_name(args.run_name or f"demo-{datetime.now():%m%d-%H%M%S}")
    demo = Demo(config, name, args.runs_dir)
    try:
        demo.play()
    except KeyboardInterrupt:
        raise StoppedError(demo.stopped_text) from None
    return 0
