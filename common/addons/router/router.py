"""A stand-alone router, for coordinators and workers that cannot reach each other directly. It has no state."""

from __future__ import annotations

import logging
from collections import Counter
from contextlib import closing
from threading import Event
from time import monotonic

import zenoh

from dreamfleet.common.printable import plural
from dreamfleet.common.security.certificate_ledger import CHECK_INTERVAL, RevocationWatcher
from dreamfleet.common.transport.network import Network
from dreamfleet.common.transport.session import open_session

log = logging.getLogger("dreamfleet.router")
SUMMARY_INTERVAL = 60.0  # seconds between two log lines about the sessions


def run_router(network: Network, stopped: Event, revocations: RevocationWatcher) -> None:
    """Route messages between all connected sessions until `stopped`; `ConnectionFailedError` if it cannot listen.

    Other routers in `network.connect` may start later, stop and return. `AccessError` once its own file is revoked or
    expired.
    """
    with closing(open_session(network, timeout=None)) as session:
        others = f"; linked to {', '.join(network.connect)} while it is reachable" if network.connect else ""
        log.info("listening on %s%s", ", ".join(network.listen), others,
                 extra={"facts": {"event": "begin", "listen": network.listen, "connect": network.connect}})  # fmt: skip
        summary_at = monotonic() + SUMMARY_INTERVAL
        while not stopped.wait(CHECK_INTERVAL):
            revocations.reload_if_changed(monotonic())
            revocations.check_own_file()
            if monotonic() >= summary_at:
                summary_at += SUMMARY_INTERVAL
                _log_sessions(session)
        _log_sessions(session)


def _log_sessions(session: zenoh.Session) -> None:
    found = Counter(str(each.whatami) for each in session.info.transports())
    facts = {"event": "sessions", "clients": found["client"], "routers": found["router"]}
    log.info("%s: %s, %s", plural(found.total(), "session"), plural(found["client"], "client"),
             plural(found["router"], "router"), extra={"facts": facts})  # fmt: skip
