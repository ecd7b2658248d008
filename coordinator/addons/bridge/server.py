"""Serve the bridge: open the port, find a router, report the address, and run until stopped."""

from __future__ import annotations

import logging
from collections.abc import Callable
from time import sleep

from dreamfleet.common.addons.batches.batch_client import BatchClient
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, HandshakeRejectedError
from dreamfleet.common.host.stop_signals import interrupted_by_signals
from dreamfleet.common.transport.network import Network, wait_for_listener
from dreamfleet.coordinator.addons.bridge.app import make_app
from dreamfleet.coordinator.addons.bridge.changes import Changes
from dreamfleet.coordinator.addons.bridge.config import BridgeConfig
from dreamfleet.coordinator.addons.web import server

KEEP_ALIVE = 60  # seconds for which a connection stays while a search thinks about its next batch
RETRY = 1.0  # seconds between two tries to reach a router
log = logging.getLogger(__name__)


def serve(config: BridgeConfig, network: Network, on_ready: Callable[[str], None]) -> None:
    """Serve until SIGINT or SIGTERM, as soon as a router answers; then call `on_ready` with the URL.

    `HandshakeRejectedError` if it rejects this one.
    """
    tokens = config.read_tokens()
    with server.open_socket(config) as listening:  # a port in use is said at once
        try:
            with interrupted_by_signals():
                client = _connect(network)
        except KeyboardInterrupt:
            return
        with client:
            changes = Changes(BatchClient(client))
            app = make_app(client, changes, tokens, is_loopback=config.is_loopback)
            url = config.url(listening.getsockname()[1])
            server.serve(app, listening, lambda: on_ready(url), changes.close, KEEP_ALIVE)


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
