"""Serve the bridge: open the port, report its address, and run until stopped."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable
from contextlib import ExitStack
from time import sleep

import uvicorn

from dreamfleet.common.client.batch_client import BatchClient
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, HandshakeRejectedError
from dreamfleet.common.host.stop_signals import interrupted_by_signals
from dreamfleet.common.transport.network import Network, wait_for_listener
from dreamfleet.coordinator.addons.bridge.app import make_app
from dreamfleet.coordinator.addons.bridge.changes import Changes
from dreamfleet.coordinator.addons.bridge.config import BridgeConfig
from dreamfleet.coordinator.addons.dashboard.server import HttpConnection, open_socket, run_server, server_config

KEEP_ALIVE = 60  # seconds
RETRY = 1.0  # seconds between two tries to reach a router
log = logging.getLogger(__name__)


def serve(config: BridgeConfig, network: Network, on_ready: Callable[[str], None]) -> None:
    """Serve until SIGINT or SIGTERM, as soon as a router answers; then call `on_ready` with the URL.

    `HandshakeRejectedError` if it rejects this one.
    """
    tokens = config.read_tokens()
    with ExitStack() as stack:
        listening = stack.enter_context(open_socket(config.host, config.port))  # a port in use is said at once
        try:
            with interrupted_by_signals():
                client = stack.enter_context(_connect(network))
        except KeyboardInterrupt:
            return
        changes = Changes(BatchClient(client.session))
        app = make_app(client, changes, tokens, is_loopback=config.is_loopback)
        server = _BridgeServer(
            server_config(app, BridgeConnection, timeout_keep_alive=KEEP_ALIVE),
            changes,
        )
        address = config.address(listening.getsockname()[1])
        run_server(server, listening, lambda: on_ready(address))


def _connect(network: Network) -> Client:
    """A client of the first router that answers there."""
    waiting = False
    while True:
        wait_for_listener(network.connect, RETRY, lambda: False)
        try:
            return Client(network)
        except HandshakeRejectedError:
            raise
        except ConnectionFailedError as error:
            if not waiting:
                log.warning("%s; waiting for it", error)
            waiting = True
        sleep(RETRY)


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
