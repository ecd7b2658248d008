"""Serve the page: open the port, report its address, and run until stopped."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.host.stop_signals import interrupted_by_signals
from dreamfleet.coordinator.addons.dashboard.app import make_app
from dreamfleet.coordinator.addons.dashboard.config import DashboardConfig
from dreamfleet.coordinator.addons.dashboard.feed import Feed
from dreamfleet.coordinator.addons.dashboard.live_runs import Watcher
from dreamfleet.coordinator.addons.dashboard.view_processes import ViewProcesses

SHUTDOWN_TIMEOUT = 2  # seconds to close open pages
IDLE_TIMEOUT = 8.0  # seconds until a connection without a complete request is closed
MOST_CONNECTIONS = 800  # at a time: a process has some thousand file descriptors


def serve(
    config: DashboardConfig, watcher: Watcher, views: ViewProcesses, runs_dir: Path, on_ready: Callable[[str], None]
) -> None:
    """Serve until SIGINT or SIGTERM; call `on_ready` with the URL once the port is open."""
    feed = Feed(watcher)
    app = make_app(feed, views, runs_dir, config)
    with open_socket(config.host, config.port) as listening:
        server = _PageServer(
            server_config(app, HttpConnection),
            feed,
            views,
        )
        address = config.address(listening.getsockname()[1])
        run_server(server, listening, lambda: on_ready(address))


def run_server(server: uvicorn.Server, listening: socket.socket, on_ready: Callable[[], None]) -> None:
    """Serve until Ctrl-C or SIGTERM. uvicorn sends this process the signal again, once it has shut down."""
    with suppress(KeyboardInterrupt), interrupted_by_signals():
        on_ready()
        server.run(sockets=[listening])


def server_config(app: ASGIApp, connection: type[HttpConnection], **more: Any) -> uvicorn.Config:
    """How a web server of ours runs `app`: few headers, bounded connections, no log of its own."""
    logging.getLogger("uvicorn.error").addFilter(_OneAMinute())
    return uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        lifespan="off",
        ws="none",
        http=connection,
        limit_concurrency=MOST_CONNECTIONS,
        timeout_graceful_shutdown=SHUTDOWN_TIMEOUT,
        **more,
    )


class _OneAMinute(logging.Filter):
    """Passes each warning once a minute: anyone who reaches the port causes them, such as by malformed requests."""

    def __init__(self) -> None:
        super().__init__()
        self._next: dict[str, float] = {}  # text -> when it may be said again; uvicorn's warnings are few texts

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

    keep_alive = 0.0  # seconds for which a connection that has had a request stays at least

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept the connection as uvicorn does, and check it for idleness."""
        super().connection_made(transport)
        self._idle_after: object = self  # the request after which it was idle at the last checks; itself: it was busy
        self._idle_checks = 0
        self._schedule_idle_check()

    def _schedule_idle_check(self) -> None:
        if not self.transport.is_closing():
            self.loop.call_later(IDLE_TIMEOUT, self._drop_idle)

    def _drop_idle(self) -> None:
        is_idle = self.cycle is None or self.cycle.response_complete
        self._idle_checks = self._idle_checks + 1 if is_idle and self.cycle is self._idle_after else 0
        self._idle_after = self.cycle if is_idle else self
        if is_idle and (self.cycle is None or self._idle_checks * IDLE_TIMEOUT >= self.keep_alive):
            self.transport.close()
        self._schedule_idle_check()


class _PageServer(uvicorn.Server):
    """Closes open pages at shutdown: their streams are endless."""

    def __init__(self, config: uvicorn.Config, feed: Feed, views: ViewProcesses) -> None:
        super().__init__(config)
        self._feed, self._views = feed, views

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the streams, then shut down as uvicorn does."""
        self._feed.close()
        await self._views.close()
        await super().shutdown(sockets)


def open_socket(host: str, port: int) -> socket.socket:
    """A socket that listens there; `ConnectionFailedError` if that is not possible."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        made = socket.socket(family, kind)
    except OSError as error:
        raise ConnectionFailedError(f"cannot listen on {host}: {error.strerror or error}") from error
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(address)
        made.listen(128)
    except OSError as error:
        made.close()
        if error.errno == errno.EADDRINUSE:
            why = f"port {port} is in use, perhaps by another such page: choose another with --port N"
            raise ConnectionFailedError(why) from error
        raise ConnectionFailedError(f"cannot listen on {host}:{port}: {error.strerror}") from error
    return made
