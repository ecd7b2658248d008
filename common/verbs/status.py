"""`dreamfleet status`: how a run is, once or live."""

from __future__ import annotations

import argparse
import json
import time

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.site import offer

SUMMARY = "show how a run is: generation, population, best, workers, throughput, waste"
EXTRAS = ()
REFRESH = 0.5  # seconds


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    offer(parser, "connect")
    parser.add_argument("--run", help="name of the run (default: the only live one)")
    parser.add_argument("--json", action="store_true", help="print the documents as the wire has them")
    parser.add_argument("--watch", action="store_true", help="stay and refresh until the run ends or Ctrl-C")


def run(args: argparse.Namespace) -> int:
    """Print the status."""
    from rich.console import Console
    from rich.live import Live

    from dreamfleet.common.client import Client
    from dreamfleet.common.table import run_panel

    with Client(tuple(args.connect)) as client:
        status = client.status(args.run)
        name = status["run"]
        if args.json and not args.watch:
            workers = list(client.pages("workers", name))
            print(json.dumps({**status, "worker_list": workers}, indent=2))
            return 0
        if not args.watch:
            Console().print(run_panel(status, list(client.pages("workers", name)), list(client.pages("history", name))))
            return 0
        with Live(refresh_per_second=4) as live:
            while status["state"] != "ended":
                if args.json:
                    live.console.print_json(data=status)
                else:
                    live.update(
                        run_panel(status, list(client.pages("workers", name)), list(client.pages("history", name)))
                    )
                time.sleep(REFRESH)
                try:
                    status = client.status(name)
                except ConnectionFailedError:
                    live.console.print(f"run {name}: the coordinator left")
                    return 0
    return 0
