"""`dreamfleet status`: a run's status, once or live."""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from time import sleep
from typing import Any, TypeVar

from rich.console import Console
from rich.live import Live

from dreamfleet.common.cli.global_config import add_global_flags, add_run_argument, resolve_network
from dreamfleet.common.cli.output import print_rows
from dreamfleet.common.client.client import Client
from dreamfleet.common.client.run_view import LiveRunView
from dreamfleet.common.client.status import Status, read_status
from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.printable import one_line, plural
from dreamfleet.common.runs.lookup import naming_the_stored_run
from dreamfleet.common.runs.records import StoredGeneration, format_mean
from dreamfleet.common.schema.validation import MalformedError
from dreamfleet.common.transport.network import Network
from dreamfleet.coordinator.addons.status.status_panel import RunPanel

T = TypeVar("T")
SUMMARY = "show a run's status: generation, population, best, workers, throughput, redundant work"
EXTRAS = ()
REFRESH = 0.5  # seconds


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_global_flags(parser, "connect")
    add_run_argument(parser)
    parser.add_argument(
        "--json", action="store_true", help="print the document as the wire has it; with --watch one line each time"
    )
    parser.add_argument(
        "--watch", action="store_true",
        help="stay and refresh until the coordinator leaves or Ctrl-C, and wait for one that does not answer; in a "
        "file or a pipe a line at each change",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Print the status; if several runs are live and none is named, one line per run."""
    if args.watch:
        _watch(resolve_network(args), args.run_name, as_json=args.json)
        return 0
    with naming_the_stored_run(args.runs_dir, args.run_name), Client(resolve_network(args)) as client:
        documents = [client.document(args.run_name)] if args.run_name or args.json else client.statuses()
        if args.json:
            print(json.dumps(documents[0], indent=2))
        elif len(documents) > 1:
            print_runs(documents)
        else:
            status = read_status(documents[0] if documents else client.document())
            Console().print(_PanelBuilder(client).build(status))
    return 0


def _can_redraw() -> bool:
    """Whether the terminal can redraw; a dumb one would show nothing until the end."""
    return sys.stdout.isatty() and not Console().is_dumb_terminal


def print_runs(documents: Sequence[dict[str, Any]]) -> None:
    """One line per run; an unreadable status is a note."""
    views = []
    for document in documents:
        try:
            views.append(LiveRunView.of_status(read_status(document)))
        except MalformedError as error:  # of one run, and no matter of the others
            print(f"note: {error}", file=sys.stderr)
    rows = [
        {
            "run": each.status.run,
            "state": each.status.state,
            "generation": each.status.generation.number,
            "best": each.reported and format_mean(each.reported),
            "workers": ", ".join(filter(None, (str(each.status.workers.present), each.departed))),
            "steps/s": f"{each.status.throughput.steps_per_second:,.0f}",
            "to go": each.eta.description,
        }
        for each in sorted(views, key=lambda each: each.status.run)
    ]
    print_rows(rows, right=("generation", "steps/s"), drop_order=("steps/s", "workers", "best"))
    print(f"{plural(len(rows), 'live run')}; `dreamfleet status RUN` shows more", file=sys.stderr)


def _watch(network: Network, name: str | None, *, as_json: bool) -> None:
    """Show the status until the coordinator leaves; wait while it does not answer."""
    show = _print_json_lines if as_json else _show_live if _can_redraw() else _print_changes
    with _retry_until_answered(lambda: Client(network)) as client:
        show(client, name or str(_retry_until_answered(client.document)["run"]))


def _retry_until_answered(ask: Callable[[], T]) -> T:
    """The answer of `ask`, repeated until it answers; the failure is printed once."""
    reported = False
    while True:
        try:
            return ask()
        except ConnectionFailedError as error:
            if not reported:
                print(f"{error}; waiting for it (Ctrl-C ends)", file=sys.stderr, flush=True)
            reported = True
            sleep(REFRESH)


def _follow_documents(client: Client, name: str) -> Iterator[dict[str, Any]]:
    while True:
        try:
            yield from client.watch_documents(name, REFRESH)
        except ConnectionFailedError:
            _retry_until_answered(lambda: client.document(name))
        else:
            return


def _print_json_lines(client: Client, name: str) -> None:
    for document in _follow_documents(client, name):
        print(json.dumps(document), flush=True)


def _show_live(client: Client, name: str) -> None:
    panels = _PanelBuilder(client, fitted=True)
    with Live(refresh_per_second=4, vertical_overflow="crop") as live:
        for document in _follow_documents(client, name):
            live.update(panels.build(read_status(document)), refresh=True)


def _print_changes(client: Client, name: str) -> None:
    """Print a line whenever generation, evaluations, state or workers change; at the end the panel."""
    shown = None
    for status in map(read_status, _follow_documents(client, name)):
        now = status.state, status.generation.number, status.evaluations, status.workers.present
        if now != shown:
            print(one_line(f"{status.run}: {LiveRunView.of_status(status).summary}"), flush=True)
        shown = now
    Console().print(_PanelBuilder(client).build(status))


class _PanelBuilder:
    """Draws each status with all workers and closed generations; each generation is requested once."""

    def __init__(self, client: Client, *, fitted: bool = False) -> None:
        self._client = client
        self._fitted = fitted
        self._run_uid = ""
        self._history: list[StoredGeneration] = []

    def build(self, status: Status) -> RunPanel:
        """The panel of this status."""
        whole = replace(_with_all_workers(self._client, status), recent=tuple(self._full_history(status)))
        return RunPanel(whole, self._client.worker_flags, fitted=self._fitted)

    def _full_history(self, status: Status) -> list[StoredGeneration]:
        if status.run_uid != self._run_uid:
            self._run_uid, self._history = status.run_uid, []
        if not status.is_over and status.recent and status.recent[0].number > self._next_generation:
            with suppress(ConnectionFailedError):
                self._history += self._client.history(status.run, len(self._history))
        self._history += [each for each in status.recent if each.number >= self._next_generation]
        return self._history

    @property
    def _next_generation(self) -> int:
        return self._history[-1].number + 1 if self._history else 0


def _with_all_workers(client: Client, status: Status) -> Status:
    """The same with the rows that did not fit, as long as the coordinator answers."""
    if status.is_over or len(status.worker_list) >= status.workers.known:
        return status
    with suppress(ConnectionFailedError):
        return replace(status, worker_list=tuple(client.workers(status.run)))
    return status
