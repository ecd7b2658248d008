"""`dreamfleet serve`: batches over HTTP, for searches in any language."""

import argparse
import logging
import shlex
import stat
import sys
from dataclasses import dataclass
from pathlib import Path
from time import sleep

from dreamfleet.common.addons.batches.batch_client import BatchClient
from dreamfleet.common.cli.config import add_flags, load, option
from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.cli.output import print_next
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, HandshakeRejectedError, UsageError
from dreamfleet.common.host.reports import ADDRESS, report
from dreamfleet.common.host.stop_signals import interrupted_by_signals
from dreamfleet.common.transport.network import Network, wait_for_listener
from dreamfleet.coordinator.addons.web.address import WebAddress

SUMMARY = "let a search in any language score batches over HTTP"
EXTRAS = ("dashboard",)
FIRST = "--connect --join --port --host --token-file"
KEEP_ALIVE = 60  # seconds for which a connection stays while a search thinks about its next batch
LEAST_TOKEN = 16  # characters: anyone who reaches the port can guess
MOST_TOKENS = 1000
RETRY = 1.0  # seconds between two tries to reach a router
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BridgeConfig(WebAddress):
    """Where the bridge listens, and the file of its tokens."""

    host: str = option("127.0.0.1", "listen here; addresses that others can reach need --token-file")
    port: int = option(8700, "port; 0: any that is free")
    token_file: str | None = option(None, "file with a token in each line; every request must bear one of them")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.token_file is None and not self.is_loopback:
            raise UsageError(f"--host {self.host} lets others submit batches: give a --token-file, or leave --host out")

    def read_tokens(self) -> tuple[str, ...]:
        """The tokens, none without a file; `UsageError` if others may read the file, or a token is short."""
        if self.token_file is None:
            return ()
        path = Path(self.token_file)
        make = f"(umask 077; openssl rand -hex 32 > {shlex.quote(str(path))})"
        try:
            if path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
                raise UsageError(f"other users may read {path}: chmod 600 {shlex.quote(str(path))}")
            lines = path.read_text().splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(f"--token-file {path} cannot be read ({error}); make one: {make}") from error
        tokens = tuple(filter(None, (line.strip() for line in lines if not line.startswith("#"))))
        if not tokens or len(tokens) > MOST_TOKENS:
            raise UsageError(f"{path} must hold 1 to {MOST_TOKENS} tokens, one a line; make one: {make}")
        if any(len(each) < LEAST_TOKEN or not each.isascii() for each in tokens):
            raise UsageError(f"each token in {path} must have at least {LEAST_TOKEN} ASCII characters: {make}")
        return tokens


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
