"""`dreamfleet worker`: score for a run, from any host."""

from __future__ import annotations

import argparse
import signal

from dreamfleet.common.cli.config import add_flags, load
from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.host.nonblocking_io import make_stderr_nonblocking
from dreamfleet.common.host.resource_limits import raise_open_file_limit
from dreamfleet.worker.service.config import WorkerConfig

SUMMARY = "score candidates for a run; it needs no files and no display, and may start before its coordinator"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_global_flags(parser, "connect")
    parser.add_argument("--task", nargs="+", default=[], metavar="MODULE:NAME", help="tasks that no package registers")
    add_flags(parser, WorkerConfig)


def run(args: argparse.Namespace) -> int:
    """Serve until stopped; the first Ctrl-C drains, the second leaves at once."""
    from dreamfleet.worker.service.worker import Worker

    make_stderr_nonblocking()
    raise_open_file_limit()
    config = load(WorkerConfig, "worker", **args.sources)
    worker = Worker(config, resolve_network(args, "worker", "coordinator"), tuple(args.task))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: worker.stop())
    worker.serve()
    return 0
