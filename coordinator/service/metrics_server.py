"""`/metrics` of a coordinator, in a thread of its own: read-only, from the latest snapshot."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, HTTPServer
from time import monotonic, sleep

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.monitoring.prometheus import CONTENT_TYPE, exposition
from dreamfleet.common.transport.network import parse_metrics_address
from dreamfleet.coordinator.service.status import Snapshot, full_status

PATIENCE = 5.0  # seconds for a whole question and its answer: one client at a time is answered
POLL = 0.1  # seconds
LONGEST = 90.0  # seconds that an ended run waits for whoever scrapes to hear of its end


@contextmanager
def serve_metrics(where: str, snapshot: Callable[[], Snapshot], stopped: Callable[[], bool]) -> Iterator[None]:
    """Answer at the address that `where` names; nowhere if it is empty. `ConnectionFailedError` where it is taken.

    Who has scraped a run that has ended meanwhile may do so once more before the port is closed, if he comes as soon as
    before and nobody has `stopped` the coordinator: else nobody would hear of the end and of the confirmed score.
    """
    if not where:
        yield
        return
    try:
        server = _MetricsServer(parse_metrics_address(where), _handler(snapshot))
    except OSError as error:
        raise ConnectionFailedError(
            f"cannot serve metrics at {where}: {error.strerror}; choose another --metrics-port"
        ) from error
    thread = threading.Thread(target=server.serve_forever, args=(0.2,), name="metrics", daemon=True)
    thread.start()
    try:
        yield
        if snapshot().status.state == "ended":
            since = monotonic()
            while server.scrapes.is_expected(since, monotonic()) and not stopped():
                sleep(POLL)
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


class ScrapeTimes:
    """When somebody asked, and of which state he was told."""

    def __init__(self) -> None:
        self._at: float | None = None
        self._interval = 0.0  # seconds between the last two times
        self._state = ""

    def record(self, state: str, now: float) -> None:
        """Somebody is told of a run of this state."""
        self._interval = 0.0 if self._at is None else now - self._at
        self._at, self._state = now, state

    def is_expected(self, since: float, now: float) -> bool:
        """Whether somebody who asks again and again has yet to hear of a run that ended at `since`."""
        return self._state != "ended" and now - since < min(2 * self._interval, LONGEST)


class _MetricsServer(HTTPServer):
    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        super().__init__(address, handler)
        self.scrapes = ScrapeTimes()

    def handle_error(self, *_: object) -> None:
        """A client that leaves, or says nothing, is no news."""


def _handler(snapshot: Callable[[], Snapshot]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = PATIENCE
        server_version = "dreamfleet"
        sys_version = ""

        def handle(self) -> None:
            """One question; who says it a byte at a time would keep others out, and the coordinator from its end."""
            late = threading.Timer(PATIENCE, self._drop)
            late.daemon = True
            late.start()
            try:
                super().handle()
            finally:
                late.cancel()

        def _drop(self) -> None:
            with suppress(OSError):  # it is gone
                self.connection.shutdown(socket.SHUT_RDWR)

        def do_GET(self) -> None:  # the name is http.server's
            if self.path.partition("?")[0] != "/metrics":
                self.send_error(HTTPStatus.NOT_FOUND, "there is /metrics")
                return
            status = full_status(snapshot())
            body = exposition(status).encode()
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
            if isinstance(self.server, _MetricsServer):
                self.server.scrapes.record(status.state, monotonic())

        def log_message(self, *_: object) -> None:
            """Every scrape would be a line."""

    return Handler
