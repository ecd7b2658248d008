"""`dreamfleet story`: what happened to a run: recent events of a live one, or what its journal keeps."""

import argparse
import json
import re
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, get_args

from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.cli.output import add_json_flag, print_rows
from dreamfleet.common.client.client import Client
from dreamfleet.common.client.status import EventKind
from dreamfleet.common.errors import ConnectionFailedError, UsageError
from dreamfleet.common.files.regular_files import is_file
from dreamfleet.common.printable import join_some
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import JOURNAL

SUMMARY = (
    "list what happened to a run: recent events of a live one's workers and jobs (given, seen, lost, accepted, ...), "
    "else what its journal on this disk keeps (workers that came and went, pauses, failures, restarts)"
)
EXTRAS = ()
FIRST = "--journal --worker --job --what --last --connect --json"
MOST_NAMED = 8  # workers by name
LAST = 40  # events that people are shown unless they say otherwise


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", nargs="?", metavar="RUN", help="name of the run (default: the only live one)")
    parser.add_argument("--journal", action="store_true", help="read RUN's journal on this disk, even if it is live")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--worker", metavar="W", help="of this worker, or of all worker processes of this host's worker")
    which.add_argument("--job", metavar="G/I", help="of this candidate's jobs: generation/index, such as 3/0")
    parser.add_argument(
        "--what", nargs="+", metavar="WORD", default=(),
        help="only events of these kinds, such as: joined back silent lost left reissued",
    )  # fmt: skip
    text = f"so many events at most (default {LAST} of a live run; all of a journal, or with --json)"
    parser.add_argument("--last", type=int, metavar="N", help=text)
    add_global_flags(parser, "connect", "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Print the events of a live run, the newest last; those of the journal if asked, or if nobody answers."""
    _check(args)
    of_live = bool(args.worker or args.job or args.what)
    if args.journal and (of_live or args.run_name is None):
        raise UsageError("--journal needs a RUN, and keeps no events of single jobs: omit --worker, --job and --what")
    if args.journal:
        return _print_journal(args)
    try:
        return _print_live(args)
    except ConnectionFailedError as error:
        if of_live or args.run_name is None or not is_file(args.runs_dir / args.run_name / JOURNAL):
            raise
        print(f"{error}; this is what its journal keeps", file=sys.stderr)
        return _print_journal(args)


def _check(args: argparse.Namespace) -> None:
    if args.job is not None and not re.fullmatch(r"\d{1,12}/\d{1,12}", args.job):
        raise UsageError(f"--job {args.job!r}: write generation/index, such as 3/0")
    if args.worker is not None and not re.fullmatch(r"[A-Za-z0-9._/-]+", args.worker):
        raise UsageError(f"--worker {args.worker!r}: give a name as `dreamfleet status` shows it")
    if args.last is not None and args.last < 1:
        raise UsageError("--last must be at least 1")
    if strange := [each for each in args.what if each not in (words := get_args(EventKind))]:
        raise UsageError(f"--what {strange[0]!r}: there are {', '.join(words)}")


def _print_live(args: argparse.Namespace) -> int:
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
        print(f"the last {len(events)} of {total} kept events; --last shows more, --what filters", file=sys.stderr)
    return 0


def _print_journal(args: argparse.Namespace) -> int:
    with open_run(args.runs_dir, args.run_name) as stored, stored.verified_transaction():
        events, failures = stored.events(), stored.failures()
    events = events[-(args.last or len(events) or 1) :]
    if args.json:
        found: dict[str, list[Any]] = {"events": events, "failures": failures}
        print(json.dumps({name: [asdict(each) for each in rows] for name, rows in found.items()}))
        return 0
    print_rows([{"time (UTC)": _format_time(each.happened), "incarnation": each.incarnation, "event": each.text}
                for each in events], right=("incarnation",))  # fmt: skip
    return 0


def _format_time(seconds: float) -> str:
    """A wall clock's time to the second; the number itself where no calendar has it."""
    try:
        return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (ValueError, OverflowError, OSError):
        return f"{seconds:g}"


def _check_known(client: Client, run: str, worker: str) -> None:
    """`UsageError` with the known names, unless `name` is a worker's or a host's."""
    events, _ = client.events(run)  # of those that are gone, too
    known = [*(each.worker for each in client.workers(run)), *(each.worker for each in events)]
    hosts = list(dict.fromkeys(host_of(each) for each in known))
    if worker in (*known, *hosts):
        return
    there = f"known are {join_some(hosts, MOST_NAMED)}" if hosts else "none has joined"
    raise UsageError(f"run {run} knows no worker {worker!r}: {there}")
