"""`dreamfleet status`: how a run is, once or live."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.site import offer, offer_run, reached

if TYPE_CHECKING:
    from dreamfleet.common.client import Client
    from dreamfleet.common.status import Status
    from dreamfleet.common.table import RunPanel

SUMMARY = "show how a run is: generation, population, best, workers, throughput, waste"
EXTRAS = ()
REFRESH = 0.5  # seconds


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    offer(parser, "connect")
    offer_run(parser)
    parser.add_argument(
        "--json", action="store_true", help="print the document as the wire has it; with --watch one line each time"
    )
    parser.add_argument(
        "--watch", action="store_true",
        help="stay and refresh until the coordinator leaves or Ctrl-C; in a file or a pipe a line at each change",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Print the status."""
    from dreamfleet.common.client import Client

    with Client(reached(args)) as client:
        document = client.document(args.run_name)
        if args.watch:
            watch = _print_lines if args.json else _show if _redraws() else _tell
            return watch(client, str(document.get("run")))
        if args.json:
            print(json.dumps(document, indent=2))
        else:
            _print_once(client, document)
    return 0


def _redraws() -> bool:
    """Whether a picture can be drawn over the last one: a terminal that is dumb would show nothing until the end."""
    from rich.console import Console

    console = Console()
    return sys.stdout.isatty() and not console.is_dumb_terminal


def _print_once(client: Client, document: dict[str, Any]) -> None:
    from rich.console import Console

    from dreamfleet.common.status import read_status

    Console().print(_panel(client, read_status(document)))


def _print_lines(client: Client, name: str) -> int:
    for document in client.watch_documents(name, REFRESH):
        print(json.dumps(document), flush=True)
    return 0


def _show(client: Client, name: str) -> int:
    from rich.live import Live

    with Live(refresh_per_second=4, vertical_overflow="crop") as live:
        for status in client.watch(name, REFRESH):
            live.update(_panel(client, status, fitted=True), refresh=True)
    return 0


def _tell(client: Client, name: str) -> int:
    """A line when a generation, an evaluation, the state or the number of workers is another; at last the picture."""
    from rich.console import Console

    from dreamfleet.common.eta import summary
    from dreamfleet.common.printable import one_line

    told = None
    for status in client.watch(name, REFRESH):
        now = status.state, status.generation.number, status.evaluations, status.workers.present
        if now != told:
            print(one_line(f"{status.run}: {summary(status)}"), flush=True)
        told = now
    Console().print(_panel(client, status))
    return 0


def _panel(client: Client, status: Status, *, fitted: bool = False) -> RunPanel:
    from dreamfleet.common.table import RunPanel

    return RunPanel(_with_all_workers(client, status), client.worker_flags, fitted=fitted)


def _with_all_workers(client: Client, status: Status) -> Status:
    """The same with those that had no room in it, while the coordinator is there to tell of them."""
    if status.over or len(status.worker_list) >= status.workers.known:
        return status
    with suppress(ConnectionFailedError):
        return replace(status, worker_list=tuple(client.workers(status.run)))
    return status
