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
from dreamfleet.coordinator.dashboard.live_runs import Watcher
from dreamfleet.coordinator.dashboard.view_processes import ViewProcesses

SHUTDOWN_TIMEOUT = 2  # seconds that open pages have to go
IDLE_TIMEOUT = 8.0  # seconds within which a connection asks for something whole
MOST_CONNECTIONS = 800  # that are answered: a process may hold some thousand descriptors


def serve(
    config: DashboardConfig, watcher: Watcher, views: ViewProcesses, runs_dir: Path, on_ready: Callable[[str], None]
) -> None:
    """Serve until SIGINT or SIGTERM; `on_ready` gets the address once it can be opened."""
    feed = Feed(watcher)
    app = make_app(feed, views, runs_dir, config)
    with _open_socket(config) as listening:
        server = _PageServer(
            uvicorn.Config(
                app,
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                lifespan="off",
                ws="none",
                http=_Connection,
                limit_concurrency=MOST_CONNECTIONS,
                timeout_graceful_shutdown=SHUTDOWN_TIMEOUT,
            ),
            feed,
            views,
        )
        on_ready(config.address(listening.getsockname()[1]))
        server.run(sockets=[listening])


class _Connection(H11Protocol):
    """Is closed while nothing is asked or answered on it: whoever sends half a request would hold it for ever."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """As uvicorn does it, and watch it."""
        super().connection_made(transport)
        self._schedule_idle_check()

    def _schedule_idle_check(self) -> None:
        if not self.transport.is_closing():
            self.loop.call_later(IDLE_TIMEOUT, self._drop_idle)

    def _drop_idle(self) -> None:
        if self.cycle is None or self.cycle.response_complete:
            self.transport.close()
        self._schedule_idle_check()


class _PageServer(uvicorn.Server):
    """Lets go of open pages as it ends: their streams have no end of their own."""

    def __init__(self, config: uvicorn.Config, feed: Feed, views: ViewProcesses) -> None:
        super().__init__(config)
        self._feed, self._views = feed, views

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """As uvicorn does it, once nobody waits for another picture."""
        self._feed.close()
        await self._views.close()
        await super().shutdown(sockets)


def _open_socket(config: DashboardConfig) -> socket.socket:
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
