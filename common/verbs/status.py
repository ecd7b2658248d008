"""`dreamfleet status`: how a run is, once or live."""

from __future__ import annotations

import argparse
import json
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.site import offer, reached

if TYPE_CHECKING:
    from dreamfleet.common.client import Client
    from dreamfleet.common.status import Status

SUMMARY = "show how a run is: generation, population, best, workers, throughput, waste"
EXTRAS = ()
REFRESH = 0.5  # seconds


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    offer(parser, "connect")
    parser.add_argument("--run", help="name of the run (default: the only live one)")
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
        document = client.document(args.run)
        if args.watch:
            name = str(document.get("run"))
            return _print_lines(client, name) if args.json else _show(client, name)
        if args.json:
            print(json.dumps(document, indent=2))
        else:
            _print_once(client, document)
    return 0


def _print_once(client: Client, document: dict[str, Any]) -> None:
    from rich.console import Console

    from dreamfleet.common.status import read_status
    from dreamfleet.common.table import RunPanel

    Console().print(RunPanel(_with_all_workers(client, read_status(document))))


def _print_lines(client: Client, name: str) -> int:
    for document in client.watch_documents(name, REFRESH):
        print(json.dumps(document), flush=True)
    return 0


def _show(client: Client, name: str) -> int:
    from rich.console import Console
    from rich.live import Live

    if not Console().is_terminal:
        return _tell(client, name)

    from dreamfleet.common.table import RunPanel

    with Live(refresh_per_second=4, vertical_overflow="crop") as live:
        for status in client.watch(name, REFRESH):
            live.update(RunPanel(_with_all_workers(client, status), fitted=live.console.is_terminal), refresh=True)
    return 0


def _tell(client: Client, name: str) -> int:
    """A line when a generation, an evaluation, the state or the number of workers is another; at last the picture."""
    from rich.console import Console

    from dreamfleet.common.eta import summary
    from dreamfleet.common.printable import one_line
    from dreamfleet.common.table import RunPanel

    told = None
    for status in client.watch(name, REFRESH):
        now = status.state, status.generation.number, status.evaluations, status.workers.present
        if now != told:
            print(one_line(f"{status.run}: {summary(status)}"), flush=True)
        told = now
    Console().print(RunPanel(_with_all_workers(client, status)))
    return 0


def _with_all_workers(client: Client, status: Status) -> Status:
    """The same with those that had no room in it, while the coordinator is there to tell of them."""
    if status.over or len(status.worker_list) >= status.workers.known:
        return status
    with suppress(ConnectionFailedError):
        return replace(status, worker_list=tuple(client.workers(status.run)))
    return status
