"""`dreamfleet demo`: everything on this machine, in minutes."""

from __future__ import annotations

import argparse
import os
from datetime import datetime
from importlib.util import find_spec

from dreamfleet.common.config import add_flags, load
from dreamfleet.common.site import offer
from dreamfleet.coordinator.demo import Demo, DemoConfig

SUMMARY = "evolve a controller on this machine in minutes, judge it, plot it and record its drive"
EXTRAS = ("worker", "views")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--run", dest="run_name", help="name of the run (default: demo and the time)")
    offer(parser, "runs_dir")
    add_flags(parser, DemoConfig)


def run(args: argparse.Namespace) -> int:
    """Play it."""
    for package in ("av", "gymnasium", "matplotlib", "onnxruntime"):
        if find_spec(package) is None:  # said now rather than after minutes of evolution
            raise ModuleNotFoundError(name=package)
    config = load(DemoConfig, "demo", **args.sources)
    os.environ["DREAMFLEET_JOIN"] = ""  # of what is begun here nothing leaves this host, whatever fleet it is of
    name = args.run_name or f"demo-{datetime.now():%m%d-%H%M%S}"
    Demo(config, name, args.runs_dir).play()
    return 0
