"""A gate before a secured router's port: strangers who connect and never prove who they are take nothing of a run.

Zenoh accepts every connection, holds it until its handshake ends or is out of time, and lets each one that failed cost
all others 100 ms (https://github.com/eclipse-zenoh/zenoh/issues/2685): a few hundred closed connections keep newcomers
out for a minute, and once a process has no descriptor left it never gets one back. So while more than
`MAX_UNAUTHENTICATED` connections have not authenticated, the kernel drops the packets of new ones. Open connections
stay, and a newcomer's kernel tries again by itself. Linux only: elsewhere there is no limit.
"""

from __future__ import annotations

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
from time import sleep

import zenoh

log = logging.getLogger("dreamfleet.router")
MAX_UNAUTHENTICATED = 32  # connections: at 100 ms each they are gone in three seconds
SPARE_DESCRIPTORS = 16  # descriptors
CHECK_INTERVAL = 0.02  # seconds from one look at the descriptors to the next
_OPEN = Path("/proc/self/fd")
_ATTACH, _DETACH = 26, 27  # SO_ATTACH_FILTER and SO_DETACH_FILTER of Linux's asm-generic/socket.h
_DROP_ALL = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0), 8)  # a socket filter: return 0 bytes
_FILTER = struct.pack("@HP", 1, ctypes.addressof(_DROP_ALL))


def limit_connections(session: zenoh.Session, ports: Collection[int]) -> None:
    """Keep a gate before the ports on which `session` listens, until it is closed."""
    if sys.platform == "linux":
        Thread(target=_ConnectionLimiter(session, ports).run, name="gate", daemon=True).start()


class _ConnectionLimiter:
    def __init__(self, session: zenoh.Session, ports: Collection[int]) -> None:
        self._info, self._ports = session.info, ports
        self._listening = [each for each in self._port_descriptors() if self._is_listening(each)]
        self._open, self._unauthenticated = 0, 0
        # Where a process has none left, Zenoh hears of that alone and ends no handshake: then it gets these back.
        self._spare = _open_spare_descriptors()
        self._blocked = False

    def run(self) -> None:
        while any(map(self._is_listening, self._listening)):  # whoever asks a session that is being closed, breaks it
            if self._is_crowded() != self._blocked:
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
        except OSError:  # no descriptor is left
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
            log.warning("more than %d connections prove nothing: newcomers wait", MAX_UNAUTHENTICATED,
                        extra={"facts": {"event": "crowd", "unproven": self._unauthenticated}})  # fmt: skip
        else:
            self._spare = _open_spare_descriptors()

    def _close_waiting(self, listening: socket.socket) -> None:
        """Close what waits to be accepted, or it would take the spare ones; Zenoh may be faster and take some."""
        while self._spare:
            os.close(self._spare.pop())
            try:
                while True:
                    listening.accept()[0].close()
            except BlockingIOError:  # nothing waits
                return
            except OSError:  # it took this one
                continue

    def _close_spare(self) -> None:
        while self._spare:
            os.close(self._spare.pop())

    def _port_descriptors(self) -> list[int]:
        """The descriptors of what listens at the ports, and of whoever connected there."""
        return [number for each in _OPEN.iterdir() if _local_port(number := int(each.name)) in self._ports]

    def _is_listening(self, number: int) -> bool:
        """Whether this is still the descriptor of what listens at one of the ports."""
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


def _local_port(number: int) -> int:
    """The port of this host that a descriptor has; 0 of one that is no internet socket, or is gone."""
    with suppress(OSError), _as_socket(number) as found:
        if found.family in (socket.AF_INET, socket.AF_INET6):
            return int(found.getsockname()[1])
    return 0


@contextmanager
def _as_socket(number: int) -> Iterator[socket.socket]:
    """Another's descriptor as a socket."""
    found = socket.socket(fileno=number)
    try:
        yield found
    finally:
        found.detach()
