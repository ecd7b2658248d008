"""Serve the bridge: open the port, report its address, and run until stopped."""

from __future__ import annotations

import socket
from collections.abc import Callable

import uvicorn

from dreamfleet.common.monitoring.batch_client import BatchClient
from dreamfleet.common.monitoring.client import Client
from dreamfleet.common.transport.network import Network
from dreamfleet.coordinator.bridge.app import make_app
from dreamfleet.coordinator.bridge.changes import Changes
from dreamfleet.coordinator.bridge.config import BridgeConfig
from dreamfleet.coordinator.dashboard.server import HttpConnection, open_socket, run_server, server_config

KEEP_ALIVE = 60  # seconds


def serve(config: BridgeConfig, network: Network, on_ready: Callable[[str], None]) -> None:
    """Serve until SIGINT or SIGTERM; call `on_ready` with the URL once the port is open."""
    tokens = config.read_tokens()
    with open_socket(config.host, config.port) as listening, Client(network) as client:
        changes = Changes(BatchClient(client.session))
        app = make_app(client, changes, tokens, is_loopback=config.is_loopback)
        server = _BridgeServer(
            server_config(app, BridgeConnection, timeout_keep_alive=KEEP_ALIVE),
            changes,
        )
        address = config.address(listening.getsockname()[1])
        run_server(server, listening, lambda: on_ready(address))


class BridgeConnection(HttpConnection):
    """A connection that stays while a search thinks about its next batch."""

    keep_alive = KEEP_ALIVE


class _BridgeServer(uvicorn.Server):
    """Ends open streams at shutdown."""

    def __init__(self, config: uvicorn.Config, changes: Changes) -> None:
        super().__init__(config)
        self._changes = changes

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the streams, then shut down as uvicorn does."""
        self._changes.close()
        await super().shutdown(sockets)
