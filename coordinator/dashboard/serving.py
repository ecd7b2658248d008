"""The page's life: a port is taken, its address told, and it is served until somebody ends it."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Callable
from pathlib import Path

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.coordinator.dashboard.app import make_app
from dreamfleet.coordinator.dashboard.config import DashboardConfig
from dreamfleet.coordinator.dashboard.feed import Feed
from dreamfleet.coordinator.dashboard.views import Views
from dreamfleet.coordinator.dashboard.watching import Watcher

LEAVE = 2  # seconds that open pages have to go
HURRY = 8.0  # seconds within which a connection asks for something whole
MOST_CONNECTIONS = 800  # that are answered: a process may hold some thousand descriptors


def serve(
    config: DashboardConfig, watcher: Watcher, views: Views, runs_dir: Path, ready: Callable[[str], None]
) -> None:
    """Serve until SIGINT or SIGTERM; `ready` is told the address once it can be opened."""
    feed = Feed(watcher)
    app = make_app(feed, views, runs_dir, config)
    with _listening(config) as listening:
        server = _Server(
            uvicorn.Config(
                app, log_config=None, access_log=False, server_header=False, proxy_headers=False, lifespan="off",
                ws="none", http=_Connection, limit_concurrency=MOST_CONNECTIONS, timeout_graceful_shutdown=LEAVE,
            ),
            feed,
            views,
        )  # fmt: skip
        ready(config.address(listening.getsockname()[1]))
        server.run(sockets=[listening])


class _Connection(H11Protocol):
    """Is closed while nothing is asked or answered on it: whoever sends half a request would hold it for ever."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """As uvicorn does it, and watch it."""
        super().connection_made(transport)
        self._watch()

    def _watch(self) -> None:
        if not self.transport.is_closing():
            self.loop.call_later(HURRY, self._drop_idle)

    def _drop_idle(self) -> None:
        if self.cycle is None or self.cycle.response_complete:
            self.transport.close()
        self._watch()


class _Server(uvicorn.Server):
    """Lets go of open pages as it ends: their streams have no end of their own."""

    def __init__(self, config: uvicorn.Config, feed: Feed, views: Views) -> None:
        super().__init__(config)
        self._feed, self._views = feed, views

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """As uvicorn does it, once nobody waits for another picture."""
        self._feed.close()
        await self._views.close()
        await super().shutdown(sockets)


def _listening(config: DashboardConfig) -> socket.socket:
    try:
        family, kind, _, _, address = socket.getaddrinfo(config.host, config.port, type=socket.SOCK_STREAM)[0]
        made = socket.socket(family, kind)
    except OSError as error:
        raise ConnectionFailedError(f"cannot listen on {config.host}: {error.strerror or error}") from error
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(address)
        made.listen(128)
    except OSError as error:
        made.close()
        if error.errno == errno.EADDRINUSE:
            why = f"port {config.port} is in use, perhaps by another such page: choose another with --port N"
            raise ConnectionFailedError(why) from error
        raise ConnectionFailedError(f"cannot listen on {config.host}:{config.port}: {error.strerror}") from error
    return made
