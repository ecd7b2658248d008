"""Endpoints: where one side listens and the others connect. Knows no transport, so that every verb may read it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from ipaddress import ip_address

from dreamfleet.common.errors import UsageError
from dreamfleet.common.security.credentials import Credentials

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
LOOPBACK = "127.0.0.1"
SECURED_PREFIX = "tls/"  # how endpoints of a fleet with join files begin
SECURED_ENDPOINT = "tls/0.0.0.0:7447"  # where such a coordinator listens by default
_ENDPOINT = re.compile(r"(tcp|tls|udp|quic|ws)/(\[[0-9a-fA-F:]+\]|[^:/\s]+):(\d{1,5})")


@dataclass(frozen=True)
class Network:
    """Where to listen and what to connect to, endpoints such as `tcp/HOST:7447`, and as whom.

    `revoked_seats` are the seats that a secured router lets do nothing.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    credentials: Credentials | None = None
    revoked_seats: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        for endpoint in (*self.listen, *self.connect):
            check_endpoint(endpoint)
            if self.credentials is not None and not endpoint.startswith(SECURED_PREFIX):
                raise UsageError(f"{endpoint} is not encrypted: with a join file it is {_to_secured(endpoint)}")
            if self.credentials is None and endpoint.startswith(SECURED_PREFIX):
                raise UsageError(f"{endpoint} is encrypted: give --join FILE, which `dreamfleet access issue` makes")
        for endpoint in self.connect:
            check_secured(endpoint)

    def check_open(self, *, insecure: bool) -> None:
        """`UsageError` where others could reach a router that lets everybody do all, and nobody said `insecure`."""
        for endpoint in self.listen:
            if self.credentials is None and not insecure and not is_loopback(endpoint):
                raise UsageError(
                    f"{endpoint} can be reached from other hosts, and whoever reaches it owns the run: give --join "
                    "FILE (`dreamfleet access`, docs/security.md), or --insecure inside a network that you trust"
                )


def _to_secured(endpoint: str) -> str:
    return SECURED_PREFIX + endpoint.partition("/")[2]


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint is of this host alone."""
    return is_loopback_host(endpoint.partition("/")[2].rpartition(":")[0].strip("[]"))


def is_loopback_host(host: str) -> bool:
    """Whether a name or an address is of this host alone."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_endpoint(endpoint: str) -> str:
    """Return `endpoint` if it is well formed, else raise `UsageError`."""
    found = _ENDPOINT.fullmatch(endpoint)
    if not found or int(found[3]) > 65535:
        run = "" if "/" in endpoint or ":" in endpoint else "; a run's name is none: --help says where it stands"
        raise UsageError(f"{endpoint!r} is no endpoint: write it as tcp/HOST:PORT, such as {DEFAULT_ENDPOINT}{run}")
    return endpoint


def check_secured(endpoint: str) -> str:
    """Return `endpoint` if Zenoh can connect to it, else raise `UsageError`: it checks no certificate for IPv6."""
    if endpoint.startswith(f"{SECURED_PREFIX}["):
        raise UsageError(f"{endpoint} cannot be reached: Zenoh speaks TLS to names and IPv4 alone; give a name")
    return endpoint


def parse_metrics_address(text: str) -> tuple[str, int]:
    """Host and port of `--metrics-port`: a port of this host alone, or HOST:PORT; `UsageError` if it is neither."""
    host, _, port = text.rpartition(":")
    if not (port.isdecimal() and 0 < int(port) <= 65535):
        raise UsageError(f"--metrics-port {text!r}: give a port such as 9108, or HOST:PORT for more than this host")
    return host.strip("[]") or LOOPBACK, int(port)
