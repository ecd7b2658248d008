"""`dreamfleet router`: a place where coordinators and workers meet that cannot reach each other."""

from __future__ import annotations

import argparse
import json
import signal
from dataclasses import dataclass
from pathlib import Path
from threading import Event

from dreamfleet.common.config import add_flags, load, option
from dreamfleet.common.descriptors import raise_limit
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.files import open_new
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
    parser.add_argument(
        "--write-config", type=Path, metavar="FILE.json5",
        help="write that to a new file of mode 600, with what the join file keeps secret, and leave",
    )  # fmt: skip


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
            raise UsageError("--print-config would print what the join file keeps secret: --write-config FILE.json5")
        print(json.dumps(settings_of(network, None), indent=2))
        return 0
    if args.write_config is not None:
        _write(args.write_config, network)
        return 0
    stopped = Event()
    for number in SIGNALS:
        signal.signal(number, lambda *_: stopped.set())
    route(network, stopped)
    return 0


def _write(path: Path, network: Network) -> None:
    """What zenohd reads, as a file; certificates and keys stand in it."""
    from dreamfleet.common.session import settings_of

    if path.suffix not in (".json", ".json5"):
        raise UsageError(f"--write-config {path}: zenohd knows what it reads by its name: end it in .json5")
    if network.credentials is not None and network.credentials.with_passwords:
        raise UsageError("--write-config is for certificates: of a fleet with passwords let this verb be the router")
    try:
        with open_new(path) as file:
            file.write(json.dumps(settings_of(network, None), indent=2).encode())
    except FileExistsError:
        raise UsageError(f"--write-config {path} exists: name another, or remove it first") from None
    except OSError as error:
        raise DreamfleetError(f"cannot write {path}: {error.strerror}; choose another --write-config") from error
