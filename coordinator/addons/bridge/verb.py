"""`dreamfleet serve`: batches over HTTP, for searches in any language."""

from __future__ import annotations

import argparse
import sys

from dreamfleet.common.cli.config import add_flags, load
from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.cli.output import print_next
from dreamfleet.common.host.reports import ADDRESS, report
from dreamfleet.coordinator.addons.bridge.config import BridgeConfig

SUMMARY = "let a search in any language score batches over HTTP"
EXTRAS = ("dashboard",)
FIRST = "--connect --join --port --host --token-file"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_global_flags(parser, "connect")
    add_flags(parser, BridgeConfig)


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    config = load(BridgeConfig, "serve", **args.sources)
    from dreamfleet.coordinator.addons.bridge.server import serve

    serve(config, resolve_network(args, "operator", "coordinator"), _print_address)
    print_next(args, ("runs", "list"))
    return 0


def _print_address(address: str) -> None:
    print(f"the bridge is at {address}\nnext: curl {address}/v1/runs", file=sys.stderr, flush=True)
    report(ADDRESS, address)
