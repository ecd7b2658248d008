"""`dreamfleet worker`: score for a run, from any host."""

import argparse

from dreamfleet.common.cli.config import add_flags, load
from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.host.logs import label_logs
from dreamfleet.common.host.reports import BEGUN, report
from dreamfleet.common.host.resource_limits import check_room_for_session, raise_open_file_limit
from dreamfleet.common.host.standard_streams import make_stderr_nonblocking
from dreamfleet.common.host.stop_signals import END_LIMIT, call_on_signals, end_within
from dreamfleet.worker.service.config import WorkerConfig

SUMMARY = "score candidates for a run; it needs no files and no display, and may start before its coordinator"
EXTRAS = ("worker",)
FIRST = "--connect --join --run --any --runs --slots --name --task --exit-when-done --lifetime"
ELSEWHERE = {"--workers": "give --slots N, the number of processes"}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_global_flags(parser, "connect")
    parser.add_argument(
        "--task", nargs="+", action="extend", default=[], metavar="MODULE:NAME", help="tasks that no package registers"
    )
    add_flags(parser, WorkerConfig)


def run(args: argparse.Namespace) -> int:
    """Serve until stopped; the first Ctrl-C drains, the second leaves at once."""
    from dreamfleet.worker.service.worker import Worker

    raise_open_file_limit()
    check_room_for_session()  # before anything else starts a thread
    make_stderr_nonblocking()
    config = load(WorkerConfig, "worker", **args.sources)
    if config.name is not None:
        label_logs(f"worker {config.name}")
    worker = Worker(config, resolve_network(args, "worker", "coordinator"), tuple(args.task), args.typed)
    call_on_signals(worker.stop)
    report(BEGUN, True)
    code = 1
    try:
        worker.serve()
        code = 0
    finally:
        # At its exit, the interpreter would wait without a limit for a child that cannot end.
        end_within(END_LIMIT, code)
    return code
