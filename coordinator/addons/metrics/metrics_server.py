"""`/metrics` of a coordinator: a read-only thread that answers from the latest snapshot."""

import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from time import monotonic, sleep
from typing import Any, cast

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.transport.network import is_loopback_host, names_loopback, parse_metrics_address
from dreamfleet.coordinator.service.snapshot import Snapshot

TIMEOUT = 5.0  # seconds for a request and its response
MOST_CLIENTS = 64  # at a time, each in a thread
POLL = 0.1  # seconds
LONGEST = 90.0  # seconds that an ended run waits for its scraper to see that it ended


@contextmanager
def serve_metrics(where: str, snapshot: Callable[[], Snapshot], stopped: Callable[[], bool]) -> Iterator[None]:
    """Serve metrics at the address `where`; `ConnectionFailedError` if the port is taken.

    After a run has ended, the port stays open for one more scrape, if a scraper keeps its interval and nobody has
    `stopped` the coordinator. Otherwise no scraper would see the end and the confirmed score.
    """
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
    """When a client scraped last, and the run state that it saw."""

    def __init__(self) -> None:
        self._at: float | None = None
        self._interval = 0.0  # seconds between the last two times
        self._state = ""

    def record(self, state: str, now: float) -> None:
        """A client has scraped and seen this run state."""
        self._interval = 0.0 if self._at is None else now - self._at
        self._at, self._state = now, state

    def is_expected(self, since: float, now: float) -> bool:
        """Whether a client that scrapes at intervals has yet to see that the run ended at `since`."""
        return self._state != "ended" and now - since < min(2 * self._interval, LONGEST)


class _MetricsServer(ThreadingHTTPServer):
    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        super().__init__(address, handler)
        self.scrapes = ScrapeTimes()
        self.is_loopback = is_loopback_host(address[0])
        self._open: dict[Any, str] = {}  # connection -> its address, the oldest first
        self._lock = threading.Lock()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a connection in a thread; where there are many, the oldest from the address with most gives way."""
        with self._lock:
            if len(self._open) >= MOST_CLIENTS:
                [(most, _)] = Counter(self._open.values()).most_common(1)
                oldest = next(each for each, address in self._open.items() if address == most)
                del self._open[oldest]
                with suppress(OSError):  # already closed
                    oldest.shutdown(socket.SHUT_RDWR)
            self._open[request] = client_address[0]
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Handle a connection, then make room for another."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._open.pop(request, None)

    def handle_error(self, *_: object) -> None:
        """Log nothing when a client disconnects or sends nothing."""


def _handler(snapshot: Callable[[], Snapshot]) -> type[BaseHTTPRequestHandler]:
    from dreamfleet.coordinator.addons.metrics.prometheus import CONTENT_TYPE, exposition  # only where they are served

    class Handler(BaseHTTPRequestHandler):
        timeout = TIMEOUT
        server_version = "dreamfleet"
        sys_version = ""

        def handle(self) -> None:
            """Handle one request; a slow client is cut off, for its thread keeps others out."""
            late = threading.Timer(TIMEOUT, self._drop)
            late.daemon = True
            late.start()
            try:
                super().handle()
            finally:
                late.cancel()

        def _drop(self) -> None:
            with suppress(OSError):  # already closed
                self.connection.shutdown(socket.SHUT_RDWR)

        def do_GET(self) -> None:  # http.server requires this name
            server = cast(_MetricsServer, self.server)
            if server.is_loopback and not names_loopback(self.headers.get("Host", "")):
                self.send_error(HTTPStatus.MISDIRECTED_REQUEST, "ask for this address as http://127.0.0.1")
                return
            if self.path.partition("?")[0] != "/metrics":
                self.send_error(HTTPStatus.NOT_FOUND, "there is only /metrics")
                return
            status = snapshot().full_status()
            body = exposition(status)
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
            server.scrapes.record(status.state, monotonic())

        def log_message(self, *_: object) -> None:
            """Log no scrape."""

    return Handler
