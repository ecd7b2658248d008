"""A limit on unauthenticated connections to a secured router's ports.

Zenoh accepts every connection, keeps it until its handshake ends or times out, and delays all others by 100 ms for each
failed one (https://github.com/eclipse-zenoh/zenoh/issues/2685). So a few hundred closed connections keep newcomers out
for a minute, and a process that ran out of descriptors never recovers. While more than `MAX_UNAUTHENTICATED`
connections are unauthenticated, a socket filter makes the kernel drop packets of new ones. Open connections stay, and a
newcomer's kernel retries. Linux only: elsewhere there is no limit.

It also closes connections of those that take part as routers without a router's or coordinator's valid seat, and lets
nobody in for a while: between linked routers Zenoh would send others' messages through them. Pages: router.md.
"""

import ctypes
import logging
import os
import socket
import struct
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from time import monotonic, sleep

import zenoh

from dreamfleet.common.host.logs import log_event
from dreamfleet.common.security.credentials import LISTENERS

log = logging.getLogger("dreamfleet.router")
MAX_UNAUTHENTICATED = 32  # at 100 ms each they are closed in three seconds
SPARE_DESCRIPTORS = 16
FALSE_ROUTER_BLOCK = 10.0  # seconds without new connections after a false router
CHECK_INTERVAL = 0.02  # seconds between checks of the descriptors
_OPEN = Path("/proc/self/fd")
_ATTACH, _DETACH = 26, 27  # SO_ATTACH_FILTER and SO_DETACH_FILTER of Linux's asm-generic/socket.h
_DROP_ALL = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0), 8)  # a socket filter: return 0 bytes
_FILTER = struct.pack("@HP", 1, ctypes.addressof(_DROP_ALL))


def limit_connections(session: zenoh.Session, ports: Collection[int], revoked_seats: Collection[str]) -> None:
    """Limit connections to the ports on which `session` listens, until it is closed."""
    if sys.platform == "linux":
        Thread(target=_ConnectionLimiter(session, ports, revoked_seats).run, name="gate", daemon=True).start()


class _ConnectionLimiter:
    def __init__(self, session: zenoh.Session, ports: Collection[int], revoked_seats: Collection[str]) -> None:
        self._info, self._ports, self._revoked_seats = session.info, ports, revoked_seats
        self._listening = [each for each in self._port_descriptors() if self._is_listening(each)]
        self._open, self._unauthenticated = 0, 0
        self._links_changed = True
        self._link_events = self._info.declare_link_events_listener(self._note_link)
        self._blocked_until = 0.0  # by the monotonic clock
        self._warned: set[str | None] = set()  # seats whose connections were closed
        # Out of descriptors, Zenoh only reports that and completes no handshake; closing these lets it continue.
        self._spare = _open_spare_descriptors()
        self._blocked = False

    def run(self) -> None:
        while any(map(self._is_listening, self._listening)):  # querying a session that is being closed breaks it
            if self._links_changed:
                self._links_changed = False
                self._close_false_routers()
            if (self._is_crowded() or monotonic() < self._blocked_until) != self._blocked:
                self._set_blocked(not self._blocked)
            sleep(CHECK_INTERVAL)
        self._close_spare()

    def _is_crowded(self) -> bool:
        try:
            found = _OPEN.stat().st_size or sum(1 for _ in _OPEN.iterdir())  # 0: before Linux 6.2
            if found != self._open or self._unauthenticated > MAX_UNAUTHENTICATED:
                self._unauthenticated = (
                    len(self._port_descriptors()) - len(self._listening) - len(self._info.transports())
                )
                self._open = found
        except OSError:  # out of descriptors
            return True
        return self._unauthenticated > MAX_UNAUTHENTICATED

    def _set_blocked(self, blocked: bool) -> None:
        self._blocked = blocked
        for number in filter(self._is_listening, self._listening):
            with _as_socket(number) as listening:
                listening.setsockopt(socket.SOL_SOCKET, _ATTACH if blocked else _DETACH, _FILTER if blocked else 0)
                if blocked:
                    self._close_waiting(listening)
        if blocked:
            self._close_spare()
            if monotonic() >= self._blocked_until:  # that of a false router was said
                text = f"more than {MAX_UNAUTHENTICATED} connections are unauthenticated: new ones wait"
                log_event(log, "crowd", text, level=logging.WARNING, unproven=self._unauthenticated)
        else:
            self._spare = _open_spare_descriptors()

    def _note_link(self, _event: zenoh.LinkEvent) -> None:
        self._links_changed = True

    def _close_false_routers(self) -> None:
        """Close the connections of sessions that route, but have no seat that may."""
        routing = {str(each.zid) for each in self._info.transports() if str(each.whatami) != "client"}
        links = [each for each in self._info.links() if str(each.zid) in routing] if routing else []
        seats = {_end(each.dst.partition("/")[2]): each.auth_identifier
                 for each in links if not self._may_route(each.auth_identifier)}  # fmt: skip
        if not seats:
            return
        self._links_changed = True  # until they are gone
        self._blocked_until = monotonic() + FALSE_ROUTER_BLOCK
        for number in self._port_descriptors():
            with suppress(OSError), _as_socket(number) as found:
                if _end("[{}]:{}".format(*found.getpeername()[:2])) in seats:
                    found.shutdown(socket.SHUT_RDWR)
        for seat in set(seats.values()) - self._warned:
            text = f"{seat} takes part as a router, which it may not: its connections are closed, and new ones wait"
            log_event(log, "false_router", text, level=logging.WARNING, identity=seat)
        self._warned |= set(seats.values())

    def _may_route(self, seat: str | None) -> bool:
        if seat is None:  # by a password, of which Zenoh says nothing
            return True
        return seat.partition(".")[0] in LISTENERS and seat not in self._revoked_seats

    def _close_waiting(self, listening: socket.socket) -> None:
        """Close waiting connections, which would take the spare descriptors; Zenoh may accept some of them first."""
        while self._spare:
            os.close(self._spare.pop())
            try:
                while True:
                    listening.accept()[0].close()
            except BlockingIOError:  # none waits
                return
            except OSError:  # Zenoh took the descriptor
                continue

    def _close_spare(self) -> None:
        while self._spare:
            os.close(self._spare.pop())

    def _port_descriptors(self) -> list[int]:
        """The descriptors of the listening sockets at the ports, and of connections to them."""
        return [number for each in _OPEN.iterdir() if _local_port(number := int(each.name)) in self._ports]

    def _is_listening(self, number: int) -> bool:
        """Whether this is still the descriptor of a listening socket at one of the ports."""
        if _local_port(number) in self._ports:
            with suppress(OSError), _as_socket(number) as found:
                return bool(found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN))
        return False


def _open_spare_descriptors() -> list[int]:
    found: list[int] = []
    with suppress(OSError):
        while len(found) < SPARE_DESCRIPTORS:
            found.append(os.open(os.devnull, os.O_RDONLY))
    return found


def _end(address: str) -> tuple[str, str]:
    """Host and port; of a link-local host without its interface, which Zenoh and Python write differently."""
    host, _, port = address.rpartition(":")
    return host.strip("[]").partition("%")[0].removeprefix("::ffff:"), port


def _local_port(number: int) -> int:
    """The local port of a descriptor; 0 if it is closed or no internet socket."""
    with suppress(OSError), _as_socket(number) as found:
        if found.family in (socket.AF_INET, socket.AF_INET6):
            return int(found.getsockname()[1])
    return 0


@contextmanager
def _as_socket(number: int) -> Iterator[socket.socket]:
    """A descriptor of somebody else as a socket; it stays open."""
    found = socket.socket(fileno=number)
    try:
        yield found
    finally:
        found.detach()
