"""Whether a session gets in where it connects to. Zenoh turns one away while another session there has its id.

Replies show a coordinator's id, which others can take while its link is cut. Only a new session has another.
"""

import logging
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from time import monotonic, sleep

import zenoh

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.transport.network import Network
from dreamfleet.common.transport.session import open_session

LINK_TIMEOUT = 10.0  # seconds without a link before it is looked into
CHECK_INTERVAL = 1.0  # seconds between two looks at the links
RELINK_TIME = 2.0  # seconds in which an open session links to a router that answers: it tries once a second


class LinkCheck:
    """Notices that an address answers, and yet does not link an open session of `network`."""

    def __init__(self, network: Network, log: logging.Logger) -> None:
        self._network, self._log = network, log
        self._linked_at = self._check_at = monotonic()
        self._patience = LINK_TIMEOUT  # doubled each time: to open the session anew may not help
        self._probe: Future[dict[str, set[str]]] | None = None
        self._threads = ThreadPoolExecutor(1)  # a session is opened in native code, which takes seconds
        self._said: set[str] = set()  # of which addresses do not answer

    def find_apart(self, session: zenoh.Session, now: float) -> list[str]:
        """The addresses for which `session` must be opened anew. Each of them lets in a new session."""
        if now < self._check_at:
            return []
        self._check_at = now + CHECK_INTERVAL
        if _is_linked(session, self._network):
            self._linked_at, self._patience, self._probe, self._said = now, LINK_TIMEOUT, None, set()
        elif self._probe is None and now - self._linked_at >= self._patience:
            self._probe = self._threads.submit(self._find_routers)
        elif self._probe is not None and self._probe.done():
            found, self._probe, self._linked_at = self._probe.result(), None, now
            return self._judge(found, {str(session.info.zid()), *map(str, session.info.routers_zid())})
        return []

    def _find_routers(self) -> dict[str, set[str]]:
        found: dict[str, set[str]] = {}
        for each in self._network.connect:
            try:
                with closing(open_session(replace(self._network, listen=(), connect=(each,)))) as client:
                    found[each] = set(map(str, client.info.routers_zid()))
            except DreamfleetError:
                found[each] = set()
        sleep(RELINK_TIME if any(found.values()) else 0.0)
        return found

    def _judge(self, found: dict[str, set[str]], linked: set[str]) -> list[str]:
        for each in (each for each, routers in found.items() if not routers and each not in self._said):
            self._said.add(each)
            self._log.warning("not linked to %s: it does not answer", each, extra={"facts": {"event": "unlinked"}})
        apart = [each for each, routers in found.items() if routers and linked.isdisjoint(routers)]
        if apart:
            self._patience *= 2
            text = "%s answers, but another session there may have this one's id: it is opened anew, with another id"
            self._log.warning(text, ", ".join(apart), extra={"facts": {"event": "apart", "connect": apart}})
        return apart


def _is_linked(session: zenoh.Session, network: Network) -> bool:
    """Whether a router is linked to all of its addresses, or a client to one of them."""
    if not network.listen:
        return bool(session.info.routers_zid())
    ports = {each.rpartition(":")[2] for each in network.connect}
    routers = {str(each.zid) for each in session.info.transports() if str(each.whatami) == "router"}
    ends = {each.dst for each in session.info.links() if str(each.zid) in routers}
    return sum(each.rpartition(":")[2] in ports for each in ends) >= len(network.connect)
