"""`dreamfleet worker`: score for a run, from any host."""

from __future__ import annotations

import argparse
import logging
import os
import signal
from pathlib import Path

from dreamfleet.common.config import add_flags, load, read_toml
from dreamfleet.common.session import DEFAULT_ENDPOINT, Network
from dreamfleet.worker.service.config import WorkerConfig

SUMMARY = "score candidates for a run; needs no files and no display, and may start before its coordinator"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--connect", nargs="+", default=[DEFAULT_ENDPOINT], help=f"router (default {DEFAULT_ENDPOINT})")
    parser.add_argument("--config", type=Path, help="TOML file with [worker]")
    parser.add_argument("--task", nargs="+", default=[], metavar="MODULE:NAME", help="tasks that no package registers")
    add_flags(parser, WorkerConfig)


def run(args: argparse.Namespace) -> int:
    """Serve until stopped; the first Ctrl-C drains, the second leaves at once."""
    from dreamfleet.worker.service.worker import Worker

    logging.getLogger("dreamfleet.worker").setLevel(logging.INFO)
    config = load(WorkerConfig, "worker", flags=args, environment=os.environ, file=read_toml(args.config, ["worker"]))
    worker = Worker(config, Network(connect=tuple(args.connect)), tuple(args.task))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: worker.stop())
    worker.serve()
    return 0
