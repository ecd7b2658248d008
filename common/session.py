"""Zenoh sessions as this system opens them: configuration from ours, and the traps of the defaults closed.

Defaults listen on all interfaces with multicast scouting and gossip on; shared memory makes small messages ten times
slower; 1000 sessions are the most. None of that stands here.
"""

from __future__ import annotations

import json
import queue
from collections.abc import Callable
from typing import Any

import zenoh

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.network import Network, check_endpoint

LEASE_MS = 4000  # announced by each side: after so long without a sign the other side drops its token
MAX_RECEIVED = (
    128 * 1024
)  # bytes of a message: above it Zenoh itself lets go; the largest of the protocol is MAX_MESSAGE
__all__ = ["LEASE_MS", "Network", "check_endpoint", "enqueue_into", "open_session"]  # an endpoint is of both


def open_session(network: Network, *, timeout: float = 3.0) -> zenoh.Session:
    """A router where `network.listen` is given, else a client; `ConnectionFailedError` after `timeout` seconds.

    Once open, a client reconnects by itself for ever. Zenoh's own endless first attempt (`timeout_ms` -1) blocks in
    native code where no signal is heard, so whoever wants to wait calls again.
    """
    settings = _settings(network, timeout_ms=int(timeout * 1000))
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError as error:
        raise ConnectionFailedError(_explain(network, error)) from error


def _settings(network: Network, timeout_ms: int) -> dict[str, Any]:
    router = bool(network.listen)
    transport = {
        "unicast": {"max_sessions": 10_000, "accept_pending": 10_000} if router else {},
        "shared_memory": {"enabled": False},
        "link": {
            "rx": {"max_message_size": MAX_RECEIVED},
            "tx": {
                "lease": LEASE_MS,
                "keep_alive": 4,
                "queue": {"congestion_control": {"block": {"wait_before_close": 500_000}}},
            },
        },
    }
    retry = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
    return {
        "mode": "router" if router else "client",
        "listen": {"endpoints": list(network.listen), "exit_on_failure": True},
        "connect": {
            "endpoints": list(network.connect),
            "timeout_ms": timeout_ms,
            "exit_on_failure": True,
            "retry": retry,
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": transport,
    }


def _explain(network: Network, error: zenoh.ZError) -> str:
    if "Address already in use" in str(error) or "os error 98" in str(error):
        taken = ", ".join(network.listen)
        return f"{taken} is in use: stop what listens there, or choose another with --listen tcp/127.0.0.1:PORT"
    if network.listen:
        return f"cannot listen on {', '.join(network.listen)}: {_first_line(error)}"
    return (
        f"nobody answers at {', '.join(network.connect)}: start `dreamfleet coordinator` there, or name another "
        "address with --connect tcp/HOST:PORT"
    )


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:200]


def enqueue_into(inbox: queue.SimpleQueue[Any], kind: str) -> Callable[[Any], None]:
    """A Zenoh callback that only enqueues `(kind, event)`: a slow callback looks like a frozen process."""
    return zenoh.handlers.Callback(lambda event: inbox.put((kind, event)), indirect=False)
