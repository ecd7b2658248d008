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

from dreamfleet.common.descriptors import room_for_connections
from dreamfleet.common.errors import ConnectionFailedError, DreamfleetError
from dreamfleet.common.network import Network, check_endpoint

LEASE_MS = 4000  # announced by each side: after so long without a sign the other side drops its token
MOST_SESSIONS = 10_000
MAX_RECEIVED = (
    128 * 1024
)  # bytes of a message: above it Zenoh itself lets go; the largest of the protocol is MAX_MESSAGE
_NO_ROOM = "no network session can be opened: {}; give this host more room (ulimit -n, ulimit -u)"
__all__ = ["LEASE_MS", "Network", "check_endpoint", "enqueue_into", "open_session", "settings_of"]


def open_session(network: Network, *, timeout: float | None = 3.0) -> zenoh.Session:
    """A router where `network.listen` is given, else a client; `ConnectionFailedError` after `timeout` seconds.

    Once open, a client reconnects by itself for ever. Zenoh's own endless first attempt (`timeout_ms` -1) blocks a
    client in native code where no signal is heard, so whoever wants to wait calls again. A router does not block:
    without a `timeout` it opens at once, and links to others as they come.
    """
    settings = settings_of(network, timeout)
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError as error:
        if "os error 24" in str(error):
            raise DreamfleetError(_NO_ROOM.format(_first_line(error))) from error
        raise ConnectionFailedError(_explain(network, error)) from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # Zenoh's own threads or descriptors, of which there are none left
            raise
        raise DreamfleetError(_NO_ROOM.format(_first_line(error))) from error


def settings_of(network: Network, timeout: float | None) -> dict[str, Any]:
    """Zenoh's own configuration for `network`; a stand-alone `zenohd` reads a router's as well."""
    router = bool(network.listen)
    room = room_for_connections()  # else strangers who connect could keep a coordinator from writing a file
    bounds = {"max_sessions": min(MOST_SESSIONS, room * 3 // 4), "accept_pending": min(MOST_SESSIONS, room // 4)}
    transport = {
        "unicast": bounds if router else {},
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
            "timeout_ms": -1 if timeout is None else int(timeout * 1000),
            "exit_on_failure": timeout is not None,
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
        f"nobody answers at {', '.join(network.connect)}: start `dreamfleet coordinator` or `dreamfleet router` "
        "there, or name another address with --connect tcp/HOST:PORT"
    )


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0][:200]


def enqueue_into(inbox: queue.SimpleQueue[Any], kind: str, most: int | None = None) -> Callable[[Any], None]:
    """A Zenoh callback that only enqueues `(kind, event)`: a slow callback looks like a frozen process.

    Where `most` events wait already it drops: for what is said again until it is heard.
    """

    def enqueue(event: Any) -> None:
        if most is None or inbox.qsize() < most:
            inbox.put((kind, event))

    return zenoh.handlers.Callback(enqueue, indirect=False)
