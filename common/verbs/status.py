"""`dreamfleet status`: how a run is, once or live."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from dreamfleet.common.site import offer

if TYPE_CHECKING:
    from dreamfleet.common.client import Client

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
    parser.add_argument("--watch", action="store_true", help="stay and refresh until the coordinator leaves or Ctrl-C")


def run(args: argparse.Namespace) -> int:
    """Print the status."""
    from dreamfleet.common.client import Client

    with Client(args.connect) as client:
        document = client.document(args.run)
        if args.watch:
            name = str(document.get("run"))
            return _print_lines(client, name) if args.json else _show(client, name)
        if args.json:
            print(json.dumps(document, indent=2))
        else:
            _print_once(document)
    return 0


def _print_once(document: dict[str, Any]) -> None:
    from rich.console import Console

    from dreamfleet.common.status import read_status
    from dreamfleet.common.table import run_panel

    Console().print(run_panel(read_status(document)))


def _print_lines(client: Client, name: str) -> int:
    for document in client.watch_documents(name, REFRESH):
        print(json.dumps(document), flush=True)
    return 0


def _show(client: Client, name: str) -> int:
    from rich.live import Live

    from dreamfleet.common.table import run_panel

    with Live(refresh_per_second=4) as live:
        for status in client.watch(name, REFRESH):
            live.update(run_panel(status), refresh=True)
    return 0
