"""Zenoh sessions as this system opens them: configuration from ours, and the traps of the defaults closed.

Defaults listen on all interfaces with multicast scouting and gossip on; shared memory makes small messages ten times
slower; 1000 sessions are the most. None of that stands here.
"""

from __future__ import annotations

import base64
import json
import queue
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, sleep
from typing import Any

import zenoh

from dreamfleet.common.errors import ConnectionFailedError, DreamfleetError, HandshakeRejectedError
from dreamfleet.common.host.resource_limits import connection_budget
from dreamfleet.common.security.access_rules import access_control_config
from dreamfleet.common.security.connection_limiter import limit_connections
from dreamfleet.common.security.credentials import SEATS, Credentials, derive_password, identity
from dreamfleet.common.security.handshake import diagnose_connection
from dreamfleet.common.transport.network import SECURED_PREFIX, Network, check_endpoint

CONNECT_TIMEOUT = 3.0  # seconds that a link may take to open: TLS takes four round trips and more
LEASE_MS = 4000  # announced by each side: after so long without a sign the other side drops its token
MAX_SESSIONS = 10_000
MAX_RECEIVED = (
    128 * 1024
)  # bytes of a message: above it Zenoh itself lets go; the largest of the protocol is MAX_MESSAGE
# Bytes of a message that a router passes on; the room beside the protocol's own limit is for messages that show as
# too large in a coordinator's status. Zenoh drops what is larger silently.
MAX_FORWARDED = 64 * 1024
_NO_ROOM = "no network session can be opened: {}; give this host more room (ulimit -n, ulimit -u)"
__all__ = ["LEASE_MS", "Network", "check_endpoint", "enqueue_into", "open_session", "zenoh_config"]


def open_session(network: Network, *, timeout: float | None = CONNECT_TIMEOUT) -> zenoh.Session:
    """A router where `network.listen` is given, else a client; `ConnectionFailedError` after `timeout` seconds.

    It is a `HandshakeRejectedError` where somebody listens who does not let this side in, and can be seen to.

    Once open, a client reconnects by itself for ever, at any of its addresses. Zenoh's own first attempt never leaves
    the first one, and blocks in native code where no signal is heard: so whoever wants to wait calls again, and the one
    of several that answers is found before. A router does not block: without a `timeout` it opens at once, and links to
    others as they come.
    """
    with _password_file(network) as dictionary:
        if network.listen or len(network.connect) < 2:
            session = _open_or_explain(network, lambda: _open_zenoh(zenoh_config(network, timeout, dictionary)))
        else:
            session = _open_or_explain(
                network, lambda: _open_zenoh(zenoh_config(_reachable_first(network, timeout or 0.0), CONNECT_TIMEOUT))
            )
    if network.listen and network.credentials is not None:
        limit_connections(session, {int(each.rpartition(":")[2]) for each in network.listen})
    return session


def _reachable_first(network: Network, timeout: float) -> Network:
    """The same with an address in front that answers; each may take an attempt, for one may swallow what it is sent."""
    deadline, pause = monotonic() + timeout, 0.1
    while True:
        for each in network.connect:
            try:
                settings = zenoh_config(replace(network, connect=(each,)), CONNECT_TIMEOUT)
                settings["connect"]["retry"]["period_init_ms"] = 0  # once: of a session that stays it would never rest
                _open_zenoh(settings).close()  # type: ignore[no-untyped-call]
            except zenoh.ZError:
                if monotonic() >= deadline and each == network.connect[-1]:
                    raise
            else:
                return replace(network, connect=(each, *(other for other in network.connect if other != each)))
        sleep(pause)
        pause = min(1.5 * pause, 1.0)


def _open_zenoh(settings: dict[str, Any]) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


def _open_or_explain(network: Network, begin: Callable[[], zenoh.Session]) -> zenoh.Session:
    try:
        return begin()
    except zenoh.ZError as error:
        if "os error 24" in str(error):
            raise DreamfleetError(_NO_ROOM.format(_first_line(error))) from error
        raise _connection_error(network, error) from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # Zenoh's own threads or descriptors, of which there are none left
            raise
        raise DreamfleetError(_NO_ROOM.format(_first_line(error))) from error


def zenoh_config(network: Network, timeout: float | None, dictionary: str | None = None) -> dict[str, Any]:
    """Zenoh's own configuration for `network`; a stand-alone `zenohd` reads a router's as well.

    With credentials it holds their secrets; `dictionary` is a file of the users' passwords.
    """
    router, credentials = bool(network.listen), network.credentials
    room = connection_budget()  # else strangers who connect could keep a coordinator from writing a file
    bounds = {"max_sessions": min(MAX_SESSIONS, room * 3 // 4), "accept_pending": min(MAX_SESSIONS, room // 4)}
    transport: dict[str, Any] = {
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
    guards: dict[str, Any] = {}
    if router:
        passed = {"messages": ["put", "query", "reply"], "flows": ["ingress"], "key_exprs": ["**"]}
        guards["low_pass_filter"] = [{"id": "all", **passed, "size_limit": MAX_FORWARDED}]
    if credentials is not None:
        transport["link"] |= {"protocols": ["tls"], "tls": _tls(credentials)}
        if credentials.uses_passwords:
            transport["auth"] = {"usrpwd": _password_config(credentials, dictionary)}
        if router:
            guards["access_control"] = access_control_config(credentials.uses_passwords, network.revoked_seats)
    retry = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
    return {
        "mode": "router" if router else "client",
        "listen": {"endpoints": _listen_endpoints(network), "exit_on_failure": True},
        "connect": {
            "endpoints": list(network.connect),
            "timeout_ms": -1 if timeout is None else int(timeout * 1000),
            "exit_on_failure": timeout is not None,
            "retry": retry,
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": transport,
        **guards,
    }


def _listen_endpoints(network: Network) -> list[str]:
    """Where a router listens, and for how long a secured one holds a stranger who says nothing."""
    patience = "" if network.credentials is None else f"#tls_handshake_timeout_ms={int(1000 * CONNECT_TIMEOUT)}"
    return [each + patience for each in network.listen]


def _tls(credentials: Credentials) -> dict[str, Any]:
    """Both ends of a link show their certificates; where passwords are in force, only who listens does."""
    settings = {"root_ca_certificate_base64": _base64(credentials.ca), "enable_mtls": not credentials.uses_passwords,
                "verify_name_on_connect": True, "close_link_on_expiration": True}  # fmt: skip
    if credentials.certificate:
        for side in ("listen", "connect"):
            settings[f"{side}_certificate_base64"] = _base64(credentials.certificate)
            settings[f"{side}_private_key_base64"] = _base64(credentials.key)
    return settings


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


def _password_config(credentials: Credentials, dictionary: str | None) -> dict[str, str]:
    own = credentials.password or derive_password(credentials.secret, credentials.identity)
    return {"user": credentials.identity, "password": own, **({"dictionary_file": dictionary} if dictionary else {})}


@contextmanager
def _password_file(network: Network) -> Iterator[str | None]:
    """The file that Zenoh reads the users' passwords from as it opens, and nobody else; it is gone afterwards."""
    secret = network.credentials.secret if network.credentials and network.listen else ""
    if not secret:
        yield None
        return
    users = [identity(role, seat) for role, seats in SEATS.items() for seat in range(1, seats + 1)]
    with TemporaryDirectory(prefix="dreamfleet-") as folder:  # mode 700
        path = Path(folder) / "users"
        path.write_text("".join(f"{each}:{derive_password(secret, each)}\n" for each in users))
        yield str(path)


def _connection_error(network: Network, error: zenoh.ZError) -> ConnectionFailedError:
    protocol = "tcp/" if network.credentials is None else SECURED_PREFIX
    if "Address already in use" in str(error) or "os error 98" in str(error):
        return ConnectionFailedError(
            f"{', '.join(network.listen)} is in use: stop what listens there, or choose another with --listen "
            f"{protocol}127.0.0.1:PORT"
        )
    if network.listen and "Unable to connect" not in str(error):
        return ConnectionFailedError(f"cannot listen on {', '.join(network.listen)}: {_first_line(error)}")
    if found := diagnose_connection(network.connect, network.credentials):
        return HandshakeRejectedError(found)
    return ConnectionFailedError(
        f"nobody answers at {', '.join(network.connect)}: start `dreamfleet coordinator` or `dreamfleet router` "
        f"there, or name another address with --connect {protocol}HOST:PORT"
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
