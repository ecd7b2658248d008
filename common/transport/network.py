"""Network endpoints. Imports no transport library, so that every verb can import it quickly. Pages: monitor.md."""

import re
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from time import monotonic, sleep

from dreamfleet.common.errors import UsageError
from dreamfleet.common.security.credentials import Credentials

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
LOOPBACK = "127.0.0.1"
SECURED_PREFIX = "tls/"  # prefix of a secured fleet's endpoints
SECURED_ENDPOINT = "tls/0.0.0.0:7447"  # default of a secured coordinator, which is found on its own host at the next
SECURED_LOOPBACK = "tls/127.0.0.1:7447"
LOOK_INTERVAL = 0.02  # seconds between two looks whether a process of this host listens
_LOOPBACK_HEADER = re.compile(r"(localhost|127\.\d+\.\d+\.\d+|\[::1\])(:\d+)?", re.IGNORECASE)
_ANY_ADDRESS = re.compile(r"/(0\.0\.0\.0|\[::\]):")  # all addresses of a host
_ENDPOINT = re.compile(r"(tcp|tls|udp|quic)/(\[[0-9a-fA-F:]+(?:%[\w.-]+)?\]|[^:/\s%]+):(\d{1,5})")


@dataclass(frozen=True)
class Network:
    """Endpoints such as `tcp/HOST:7447` to listen on and to connect to, with credentials in a secured fleet.

    A secured router denies everything to the seats in `revoked_seats`.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    credentials: Credentials | None = None
    revoked_seats: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        for endpoint in (*self.listen, *self.connect):
            check_endpoint(endpoint)
            if self.credentials is not None and not endpoint.startswith(SECURED_PREFIX):
                secured = SECURED_PREFIX + endpoint.partition("/")[2]
                raise UsageError(f"{endpoint} is not encrypted: with a join file it is {secured}")
            if self.credentials is None and endpoint.startswith(SECURED_PREFIX):
                raise UsageError(f"{endpoint} is encrypted: give --join FILE, which `dreamfleet access issue` makes")
        for endpoint in self.connect:
            check_secured(endpoint)

    def check_open(self, *, insecure: bool) -> None:
        """`UsageError` if other hosts can reach an unsecured router, unless `insecure` allows that."""
        for endpoint in self.listen:
            if self.credentials is None and not insecure and not is_loopback(endpoint):
                raise UsageError(
                    f"{endpoint} is open to other hosts, and anyone who reaches it controls the run: give --join "
                    "FILE (`dreamfleet access`, docs/how-to/security.md), or --insecure inside a network that you trust"
                )


def split_endpoint(endpoint: str) -> tuple[str, int]:
    """The host, without brackets, and the port of a well-formed endpoint."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


def is_loopback(endpoint: str) -> bool:
    """Whether only this host can reach an endpoint."""
    return is_loopback_host(split_endpoint(endpoint)[0])


def at_host(endpoint: str, host: str) -> str:
    """An endpoint with `host` where it listens on all addresses of its own host, else as it is."""
    return _ANY_ADDRESS.sub(lambda _: f"/{host}:", endpoint)


def wait_for_listener(endpoints: Sequence[str], seconds: float, stopped: Callable[[], bool]) -> bool:
    """Wait until something listens at one of these endpoints; return whether it does, or may.

    Only endpoints of this host are waited for, as looking there costs next to nothing. Zenoh itself would try again
    after growing pauses of up to a second.
    """
    if not all(is_loopback(each) and each.startswith(("tcp/", SECURED_PREFIX)) for each in endpoints):
        return True
    places, until = [split_endpoint(each) for each in endpoints], monotonic() + seconds
    while not any(map(_is_open, places)):
        if stopped() or monotonic() > until:
            return False
        sleep(LOOK_INTERVAL)
    return True


def _is_open(place: tuple[str, int]) -> bool:
    try:
        with socket.create_connection(place, timeout=LOOK_INTERVAL):
            return True
    except OSError:
        return False


def is_loopback_host(host: str) -> bool:
    """Whether a name or an address is this host's loopback."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def names_loopback(host_header: str) -> bool:
    """Whether a request's `Host` header names the loopback: another site's name may resolve to it (DNS rebinding)."""
    return bool(_LOOPBACK_HEADER.fullmatch(host_header))  # docs/how-to/dashboard.md promises it


def check_endpoint(endpoint: str) -> str:
    """Return `endpoint` if it is well formed, else raise `UsageError`."""
    found = _ENDPOINT.fullmatch(endpoint)
    if not found or not 0 < int(found[3]) <= 65535:
        hint = "" if "/" in endpoint or ":" in endpoint else "; a run's name goes elsewhere: see --help"
        example = f"tcp/127.0.0.1:{endpoint}" if endpoint.isdecimal() else f"{DEFAULT_ENDPOINT}{hint}"
        raise UsageError(f"{endpoint!r} is not an endpoint: write tcp/HOST:PORT, such as {example}")
    if found[1] == "quic":  # Zenoh's needs certificates, and join files give theirs to TLS
        place = endpoint.partition("/")[2]
        raise UsageError(
            f"{endpoint}: QUIC is not supported: write tcp/{place}, or {SECURED_PREFIX}{place} with --join"
        )
    return endpoint


def with_interface_index(endpoint: str) -> str:
    """An endpoint of a link-local address (`fe80::1%eth0`) with its interface's index, the only form Zenoh reads.

    `UsageError` if this host has no such interface.
    """
    head, percent, rest = endpoint.partition("%")
    interface, bracket, port = rest.partition("]")
    if not percent or interface.isdecimal():
        return endpoint
    try:
        return f"{head}%{socket.if_nametoindex(interface)}{bracket}{port}"
    except OSError:
        known = ", ".join(name for _, name in socket.if_nameindex())
        raise UsageError(f"{endpoint}: this host has no interface {interface}; it has {known}") from None


def check_secured(endpoint: str) -> str:
    """Return `endpoint` unless it is a TLS endpoint with an IPv6 address, which Zenoh cannot verify (`UsageError`)."""
    if endpoint.startswith(f"{SECURED_PREFIX}["):
        raise UsageError(f"{endpoint} cannot be reached: Zenoh supports TLS only for names and IPv4; give a name")
    return endpoint


def parse_metrics_address(text: str) -> tuple[str, int]:
    """Host and port of `--metrics-port`: PORT for loopback only, or HOST:PORT; `UsageError` for anything else."""
    host, _, port = text.rpartition(":")
    if not (port.isdecimal() and 0 < int(port) <= 65535):
        raise UsageError(f"--metrics-port {text!r}: give a port such as 9108, or HOST:PORT to serve other hosts too")
    return host.strip("[]") or LOOPBACK, int(port)
