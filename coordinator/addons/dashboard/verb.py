"""`dreamfleet dashboard`: a page about live and past runs."""

import argparse
import sys

from dreamfleet.common.cli.config import add_flags, load
from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.host.reports import ADDRESS, report
from dreamfleet.coordinator.addons.dashboard.config import DashboardConfig

SUMMARY = "serve a read-only web page about live runs and those on this disk"
EXTRAS = ("dashboard",)
FIRST = "--connect --join --port --host --runs-dir --run"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_global_flags(parser, "connect", "runs_dir")
    parser.add_argument("--run", help="follow only this run (default: every live one)")
    add_flags(parser, DashboardConfig)


def run(args: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    config = load(DashboardConfig, "dashboard", **args.sources)
    from dreamfleet.coordinator.addons.dashboard.app import make_app
    from dreamfleet.coordinator.addons.dashboard.feed import Feed
    from dreamfleet.coordinator.addons.dashboard.live_runs import Watcher
    from dreamfleet.coordinator.addons.dashboard.view_processes import ViewProcesses
    from dreamfleet.coordinator.addons.web import server

    network = resolve_network(args)
    joined = () if args.global_config.join is None else ("--join", str(args.global_config.join))
    runs_dir = args.runs_dir.absolute()  # the page shows commands to people in other folders
    views = ViewProcesses(("--connect", *network.connect, *joined), runs_dir, config.views)
    feed = Feed(Watcher(network, args.run, runs_dir))
    app = make_app(feed, views, runs_dir, config)

    async def end_streams() -> None:
        feed.close()
        await views.close()

    with server.open_socket(config) as listening:
        address = f"{config.url(listening.getsockname()[1])}/"

        def on_ready() -> None:
            print(f"the dashboard is at {address}", file=sys.stderr, flush=True)
            report(ADDRESS, address)

        server.serve(app, listening, on_ready, end_streams)
    return 0
