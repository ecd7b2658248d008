"""`dreamfleet serve`: batches over HTTP, for searches in any language."""

import argparse
import logging
import sys
from time import sleep

from dreamfleet.common.addons.batches.batch_client import BatchClient
from dreamfleet.common.cli.config import add_flags, load
from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.cli.output import print_next
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, HandshakeRejectedError
from dreamfleet.common.host.reports import ADDRESS, report
from dreamfleet.common.host.stop_signals import interrupted_by_signals
from dreamfleet.common.transport.network import Network, wait_for_listener
from dreamfleet.coordinator.addons.bridge.config import BridgeConfig

SUMMARY = "let a search in any language score batches over HTTP"
EXTRAS = ("dashboard",)
FIRST = "--connect --join --port --host --token-file"
KEEP_ALIVE = 60  # seconds for which a connection stays while a search thinks about its next batch
RETRY = 1.0  # seconds between two tries to reach a router
log = logging.getLogger(__name__)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_global_flags(parser, "connect")
    add_flags(parser, BridgeConfig)


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    config = load(BridgeConfig, "serve", **args.sources)
    _serve(config, resolve_network(args, "operator", "coordinator"))
    print_next(args, ("runs", "list"))
    return 0


def _serve(config: BridgeConfig, network: Network) -> None:
    """Serve as soon as a router answers, and say where; `HandshakeRejectedError` if it rejects this one."""
    from dreamfleet.coordinator.addons.bridge.app import make_app
    from dreamfleet.coordinator.addons.bridge.changes import Changes
    from dreamfleet.coordinator.addons.web import server

    tokens = config.read_tokens()
    with server.open_socket(config) as listening:  # a port in use is said at once
        try:
            with interrupted_by_signals():
                client = _connect(network)
        except KeyboardInterrupt:
            return
        address = config.url(listening.getsockname()[1])

        def on_ready() -> None:
            print(f"the bridge is at {address}\nnext: curl {address}/v1/runs", file=sys.stderr, flush=True)
            report(ADDRESS, address)

        with client:
            changes = Changes(BatchClient(client))
            app = make_app(client, changes, tokens, is_loopback=config.is_loopback)
            server.serve(app, listening, on_ready, changes.close, KEEP_ALIVE)


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
