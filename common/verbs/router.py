"""`dreamfleet router`: a place where coordinators and workers meet that cannot reach each other."""

from __future__ import annotations

import argparse
import json
import signal
from dataclasses import dataclass
from threading import Event

from dreamfleet.common.config import add_flags, load, option
from dreamfleet.common.descriptors import raise_limit
from dreamfleet.common.errors import UsageError
from dreamfleet.common.network import DEFAULT_ENDPOINT, SECURED_ENDPOINT, Network
from dreamfleet.common.site import joined, offer
from dreamfleet.common.stopping import SIGNALS
from dreamfleet.common.unblocked import unblock_stderr

SUMMARY = "pass messages on between coordinators and workers that connect here; it keeps nothing and may be restarted"
EXTRAS = ()


@dataclass(frozen=True)
class RouterConfig:
    """Where a router of its own is reached. The site's `connect` is that very address, so it does not follow it."""

    listen: tuple[str, ...] = option((), f"listen here (default {DEFAULT_ENDPOINT})")
    connect: tuple[str, ...] = option((), "link to these routers of other networks, whenever they are there")
    insecure: bool = option(
        False, "listen beyond this host without a join file: anyone who reaches the port owns the runs behind it"
    )


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_flags(parser, RouterConfig)
    offer(parser, "join", "access_dir")
    parser.add_argument(
        "--print-config", action="store_true", help="print what Zenoh's own zenohd reads to do the same, and leave"
    )


def run(args: argparse.Namespace) -> int:
    """Route until Ctrl-C or SIGTERM."""
    from dreamfleet.common.ledger import Revocations
    from dreamfleet.common.router import route
    from dreamfleet.common.session import settings_of

    unblock_stderr()
    raise_limit()
    config = load(RouterConfig, "router", **args.sources)
    credentials = joined(args, ("router",))
    barred = Revocations(args.site.access_dir, credentials).barred
    default = DEFAULT_ENDPOINT if credentials is None else SECURED_ENDPOINT
    network = Network(config.listen or args.site.listen or (default,), config.connect, credentials, barred)
    network.check_open(insecure=config.insecure)
    if args.print_config:
        if credentials is not None:
            raise UsageError("--print-config would print what the join file keeps secret: let this verb route itself")
        print(json.dumps(settings_of(network, None), indent=2))
        return 0
    stopped = Event()
    for number in SIGNALS:
        signal.signal(number, lambda *_: stopped.set())
    route(network, stopped)
    return 0
