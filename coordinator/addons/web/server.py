"""Serve an application over HTTP: bounded connections, few headers, no log of its own, an end by Ctrl-C or SIGTERM."""

import asyncio
import errno
import logging
import socket
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import suppress
from time import monotonic

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.host.resource_limits import raise_open_file_limit
from dreamfleet.common.host.stop_signals import interrupted_by_signals
from dreamfleet.coordinator.addons.web.address import WebAddress

SHUTDOWN_TIMEOUT = 2  # seconds to close open streams
IDLE_TIMEOUT = 8.0  # seconds until a connection without a complete request is closed
MOST_CONNECTIONS = 600  # at a time; with those that wait to be accepted or closed, under a thousand file descriptors
BACKLOG = 128  # connections that wait to be accepted, which asyncio does in one step


def open_socket(where: WebAddress) -> socket.socket:
    """A socket that listens there; `ConnectionFailedError` if that is not possible."""
    host, port = where.host, where.port
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        made = socket.socket(family, kind, socket.IPPROTO_TCP)  # named, so that asyncio sends small answers at once
    except OSError as error:
        raise ConnectionFailedError(f"cannot listen on {host}: {error.strerror or error}") from error
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(address)
        made.listen(BACKLOG)
    except OSError as error:
        made.close()
        if error.errno == errno.EADDRINUSE:
            why = f"port {port} is in use, perhaps by another such page: choose another with --port N"
            raise ConnectionFailedError(why) from error
        raise ConnectionFailedError(f"cannot listen on {host}:{port}: {error.strerror}") from error
    return made


def serve(
    app: ASGIApp, listening: socket.socket, on_ready: Callable[[], None], end_streams: Callable[[], Awaitable[None]],
    keep_alive: int = 5,
) -> None:  # fmt: skip
    """Serve until Ctrl-C or SIGTERM, then await `end_streams`: those of pages are endless.

    A connection stays open for `keep_alive` seconds after a request. Above `MOST_CONNECTIONS`, each new one takes the
    place of another, so clients without a token keep nobody out.
    """
    raise_open_file_limit()
    for name in ("uvicorn.error", "asyncio"):
        logging.getLogger(name).addFilter(_OneAMinute())
    config = uvicorn.Config(
        app, log_config=None, access_log=False, server_header=False, proxy_headers=False, lifespan="off", ws="none",
        http=HttpConnection, backlog=BACKLOG, timeout_graceful_shutdown=SHUTDOWN_TIMEOUT,
        timeout_keep_alive=keep_alive,
    )  # fmt: skip
    # uvicorn sends this process the signal again, once it has shut down.
    with suppress(KeyboardInterrupt), interrupted_by_signals():
        on_ready()
        _Server(config, end_streams).run(sockets=[listening])


class _OneAMinute(logging.Filter):
    """Passes each warning once a minute: anyone who reaches the port causes them, such as by malformed requests."""

    def __init__(self) -> None:
        super().__init__()
        self._next: dict[str, float] = {}  # text -> when it may be said again; their warnings are few texts

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is logged."""
        if record.levelno != logging.WARNING:
            return True
        now = monotonic()
        if is_due := now >= self._next.get(record.msg, 0.0):
            self._next[record.msg] = now + 60.0
        return is_due


class HttpConnection(H11Protocol):
    """A connection that is closed while idle: a client with half a request would hold it for ever."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept the connection as uvicorn does, make room for it, and check it for idleness."""
        super().connection_made(transport)
        self._opened_at = monotonic()
        if len(self.connections) > MOST_CONNECTIONS:
            self._make_room()
        self._idle_after: object = self  # the request after which it was idle at the last checks; itself: it was busy
        self._idle_checks = 0
        self._schedule_idle_check()

    def _schedule_idle_check(self) -> None:
        if not self.transport.is_closing():
            self.loop.call_later(IDLE_TIMEOUT, self._drop_idle)

    def _make_room(self) -> None:
        """Close another connection, if possible an idle one: the oldest from the address that holds most of those."""
        others = [
            each for each in self.connections
            if isinstance(each, HttpConnection) and each is not self and not each.transport.is_closing()
        ]  # fmt: skip
        if len(others) < MOST_CONNECTIONS:
            return
        choice = [each for each in others if each._is_idle] or others
        addresses = [each.client and each.client[0] for each in choice]
        [(most, _)] = Counter(addresses).most_common(1)
        of_most = [each for each, address in zip(choice, addresses, strict=True) if address == most]
        min(of_most, key=lambda each: each._opened_at).transport.abort()

    @property
    def _is_idle(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _drop_idle(self) -> None:
        is_idle = self._is_idle
        self._idle_checks = self._idle_checks + 1 if is_idle and self.cycle is self._idle_after else 0
        self._idle_after = self.cycle if is_idle else self
        if is_idle and (self.cycle is None or self._idle_checks * IDLE_TIMEOUT >= self.timeout_keep_alive):
            self.transport.close()
        self._schedule_idle_check()


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, end_streams: Callable[[], Awaitable[None]]) -> None:
        super().__init__(config)
        self._end_streams = end_streams

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the streams, then shut down as uvicorn does."""
        await self._end_streams()
        await super().shutdown(sockets)
