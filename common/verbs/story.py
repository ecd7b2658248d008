"""`dreamfleet story`: recent events of a worker or a job."""

from __future__ import annotations

import argparse
import json
import re
import sys
from typing import TYPE_CHECKING, get_args

from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.cli.output import add_json_flag, print_rows
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import join_some

if TYPE_CHECKING:
    from dreamfleet.common.monitoring.client import Client

SUMMARY = "list recent events of a live run's workers and jobs: given, seen, lost, reissued, accepted, ..."
EXTRAS = ()
MOST_NAMED = 8  # workers by name
LAST = 40  # events that people are shown unless they say otherwise


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", nargs="?", metavar="RUN", help="name of the run (default: the only live one)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--worker", metavar="W", help="of this worker, or of all lives of this host's worker")
    which.add_argument("--job", metavar="G/I", help="of this candidate's jobs: generation/index, such as 3/0")
    parser.add_argument(
        "--what", nargs="+", metavar="WORD", default=(),
        help="only events of these kinds, such as: joined back silent lost left reissued",
    )  # fmt: skip
    parser.add_argument(
        "--last", type=int, metavar="N", help=f"so many events at most (default {LAST}; with --json all)"
    )
    add_global_flags(parser, "connect")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Print the events, the newest last; the number left out goes to stderr."""
    from dreamfleet.common.monitoring.client import Client
    from dreamfleet.common.monitoring.status import EventKind

    if args.job is not None and not re.fullmatch(r"\d{1,12}/\d{1,12}", args.job):
        raise UsageError(f"--job {args.job!r}: write generation/index, such as 3/0")
    if args.worker is not None and not re.fullmatch(r"[A-Za-z0-9._/-]+", args.worker):
        raise UsageError(f"--worker {args.worker!r}: give a name as `dreamfleet status` shows it")
    if args.last is not None and args.last < 1:
        raise UsageError("--last must be at least 1")
    if strange := [each for each in args.what if each not in (words := get_args(EventKind))]:
        raise UsageError(f"--what {strange[0]!r}: there are {', '.join(words)}")
    with Client(resolve_network(args)) as client:
        events, total = client.events(args.run_name, args.worker or "", args.job or "", args.what)
        if args.worker is not None and not events and not args.what:
            _check_known(client, args.run_name or client.status().run, args.worker)
    events = events[-(args.last or (len(events) if args.json else LAST)) :]
    if args.json:
        print(json.dumps([vars(each) for each in events]))
        return 0
    print_rows([{"seconds ago": f"{each.ago:.2f}", "what": each.what, "job": each.job or None, "worker": each.worker,
                 **({"why": each.why or None} if any(one.why for one in events) else {})}
                for each in events], right=("seconds ago",))  # fmt: skip
    if not events:
        print("no such event is kept: it is too old, or has not happened yet", file=sys.stderr)
    elif total > len(events):
        print(
            f"the last {len(events)} of {total} kept events; --last shows more, --what filters",
            file=sys.stderr,
        )
    return 0


def _check_known(client: Client, run: str, worker: str) -> None:
    """`UsageError` with the known names, unless `name` is a worker's or a host's."""
    events, _ = client.events(run)  # of those that are gone, too
    known = [*(each.worker for each in client.workers(run)), *(each.worker for each in events)]
    hosts = list(dict.fromkeys(each.partition("/")[0] for each in known))
    if worker in (*known, *hosts):
        return
    there = f"known are {join_some(hosts, MOST_NAMED)}" if hosts else "none has joined"
    raise UsageError(f"run {run} knows no worker {worker!r}: {there}")
