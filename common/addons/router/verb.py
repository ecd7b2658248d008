"""`dreamfleet router`: a meeting point, without state, for coordinators and workers that cannot reach each other.

Pages: monitor.md.
"""

import argparse
import json
import logging
import signal
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from time import monotonic

import zenoh

from dreamfleet.common.cli.config import add_flags, load, option
from dreamfleet.common.cli.global_config import GlobalConfig, add_global_flags, load_credentials
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.files.atomic_write import open_new
from dreamfleet.common.host.resource_limits import raise_open_file_limit
from dreamfleet.common.host.standard_streams import make_stderr_nonblocking
from dreamfleet.common.host.stop_signals import SIGNALS
from dreamfleet.common.printable import plural
from dreamfleet.common.security.certificate_ledger import CHECK_INTERVAL, RevocationWatcher
from dreamfleet.common.transport.link_check import LinkCheck
from dreamfleet.common.transport.network import DEFAULT_ENDPOINT, SECURED_ENDPOINT, Network
from dreamfleet.common.transport.session import open_session, zenoh_config

SUMMARY = "forward messages between coordinators and workers that connect here; it stores nothing and may be restarted"
EXTRAS = ()
SUMMARY_INTERVAL = 60.0  # seconds between two log lines about the sessions
log = logging.getLogger("dreamfleet.router")


@dataclass(frozen=True)
class RouterConfig:
    """Where a router of its own is reached. The site's `connect` is that very address, so it does not follow it.

    The `connect` of its own join file was issued for it, so that holds where its own setting names none.
    """

    listen: tuple[str, ...] = option((), f"listen here (default {DEFAULT_ENDPOINT})")
    connect: tuple[str, ...] = option((), "link to these routers of other networks (default: as the join file says)")
    insecure: bool = option(
        False, "listen beyond this host without a join file: anyone who reaches the port owns the runs behind it"
    )


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_flags(parser, RouterConfig)
    add_global_flags(parser, "join", "access_dir")
    text = "print the configuration with which Zenoh's own zenohd does the same, and exit"
    parser.add_argument("--print-config", action="store_true", help=text)
    parser.add_argument(
        "--write-config", type=Path, metavar="FILE.json5",
        help="write that to a new file of mode 600, with the join file's secrets, and exit",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Route until Ctrl-C or SIGTERM."""
    make_stderr_nonblocking()
    raise_open_file_limit()
    config = load(RouterConfig, "router", **args.sources)
    credentials = load_credentials(args, ("router",))
    access_dir = args.global_config.access_dir
    revocations = RevocationWatcher(access_dir, credentials, named=access_dir != GlobalConfig.access_dir)
    default, linked = (DEFAULT_ENDPOINT, ()) if credentials is None else (SECURED_ENDPOINT, credentials.connect)
    network = Network(
        config.listen or args.global_config.listen or (default,), config.connect or linked, credentials,
        revocations.revoked_seats,
    )  # fmt: skip
    network.check_open(insecure=config.insecure)
    if args.print_config:
        if credentials is not None:
            raise UsageError("--print-config would print what the join file keeps secret: --write-config FILE.json5")
        print(json.dumps(zenoh_config(network, None), indent=2))
        return 0
    if args.write_config is not None:
        _write_config(args.write_config, network)
        return 0
    stopped = Event()
    for number in SIGNALS:
        signal.signal(number, lambda *_: stopped.set())
    run_router(network, stopped, revocations)
    return 0


def run_router(network: Network, stopped: Event, revocations: RevocationWatcher) -> None:
    """Route messages between all connected sessions until `stopped`; `ConnectionFailedError` if it cannot listen.

    Other routers in `network.connect` may start later, stop and return. If one of them answers and stays unlinked, the
    router begins again with another id. `AccessError` once its own file is revoked or expired.
    """
    others = f"; linked to {', '.join(network.connect)} while it is reachable" if network.connect else ""
    log.info("listening on %s%s", ", ".join(network.listen), others,
             extra={"facts": {"event": "begin", "listen": network.listen, "connect": network.connect}})  # fmt: skip
    link_check = LinkCheck(network, log)
    while not stopped.is_set():
        network = replace(network, revoked_seats=revocations.revoked_seats)
        with closing(open_session(network, timeout=None)) as session:
            _route(session, link_check, stopped, revocations)


def _route(session: zenoh.Session, link_check: LinkCheck, stopped: Event, revocations: RevocationWatcher) -> None:
    """Route until `stopped`, or until another router answers and does not link this one."""
    summary_at = monotonic()
    while not stopped.wait(CHECK_INTERVAL):
        now = monotonic()
        revocations.reload_if_changed(now)
        revocations.check_own_file()
        if now - summary_at >= SUMMARY_INTERVAL:
            summary_at = now
            _log_sessions(session)
        if link_check.find_apart(session, now):
            return
    _log_sessions(session)


def _log_sessions(session: zenoh.Session) -> None:
    found = Counter(str(each.whatami) for each in session.info.transports())
    facts = {"event": "sessions", "clients": found["client"], "routers": found["router"]}
    log.info("%s: %s, %s", plural(found.total(), "session"), plural(found["client"], "client"),
             plural(found["router"], "router"), extra={"facts": facts})  # fmt: skip


def _write_config(path: Path, network: Network) -> None:
    """Write zenohd's configuration to a file, with certificates and keys in it."""
    if path.suffix not in (".json", ".json5"):
        raise UsageError(f"--write-config {path}: zenohd knows what it reads by its name: end it in .json5")
    if network.credentials is not None and network.credentials.uses_passwords:
        raise UsageError("--write-config is for certificates: of a fleet with passwords let this verb be the router")
    try:
        with open_new(path) as file:
            file.write(json.dumps(zenoh_config(network, None), indent=2).encode())
    except FileExistsError:
        raise UsageError(f"--write-config {path} exists: name another") from None
    except OSError as error:
        raise DreamfleetError(f"cannot write {path}: {error.strerror}; choose another --write-config") from error
