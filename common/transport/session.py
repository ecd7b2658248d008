"""Opening Zenoh sessions with a safe configuration.

Zenoh's defaults listen everywhere with scouting and gossip, use shared memory, which makes small messages ten times
slower, and allow 1000 sessions. This changes all that. Pages: decisions.md, measurements.md, operations-notes.md.
"""

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
from dreamfleet.common.host.resource_limits import check_room_for_session, connection_budget
from dreamfleet.common.security.access_rules import access_control_config
from dreamfleet.common.security.connection_limiter import limit_connections
from dreamfleet.common.security.credentials import SEATS, Credentials, derive_password, identity
from dreamfleet.common.security.handshake import diagnose_connection
from dreamfleet.common.transport.network import SECURED_PREFIX, Network, check_endpoint, with_interface_index

CONNECT_TIMEOUT = 3.0  # seconds to open a link; TLS takes four or more round trips
LEASE_MS = 4000  # after so long without a message the other side drops a session's liveliness tokens
MAX_SESSIONS = 10_000
MAX_RECEIVED = 128 * 1024  # bytes of a message; for a larger one Zenoh closes the link
# Bytes of a message that a router forwards, else Zenoh drops it: above MAX_MESSAGE, so that oversize ones are counted.
MAX_FORWARDED = 64 * 1024
SEND_QUEUE = 16  # batches of 64 KiB that may wait on a link, Zenoh's most; beyond them it drops messages
# Microseconds that a message waits for room in the queue before it is dropped. A stalled link makes one message wait:
# Zenoh drops those after it at once, until there is room.
DROP_TIMEOUT = 5_000
_NO_ROOM = "no network session can be opened: {}; give this host more room (ulimit -n, ulimit -u)"
__all__ = ["LEASE_MS", "Network", "check_endpoint", "enqueue_into", "open_session", "zenoh_config"]


def open_session(network: Network, *, timeout: float | None = CONNECT_TIMEOUT) -> zenoh.Session:
    """Open a session: a router if `network.listen` is set, else a client.

    `ConnectionFailedError` after `timeout` seconds; `HandshakeRejectedError` if the other side rejects this one.

    An open client reconnects for ever, to any of its addresses. But Zenoh's first attempt tries only the first
    address, and blocks in native code, where signals are not handled. So the reachable one of several addresses is
    found first, and callers that want to wait longer call again. A router without `timeout` opens at once and links
    to others as they become reachable.
    """
    check_room_for_session()
    with _password_file(network) as dictionary, _errors_explained(network):
        if not network.listen and len(network.connect) > 1:
            network, timeout = _reachable_first(network, timeout or 0.0), CONNECT_TIMEOUT
        session = _open_zenoh(zenoh_config(network, timeout, dictionary))
    if network.listen and network.credentials is not None:
        ports = {int(each.rpartition(":")[2]) for each in network.listen}
        limit_connections(session, ports, network.revoked_seats)
    return session


def _reachable_first(network: Network, timeout: float) -> Network:
    """The network with a reachable address first. Each gets a full attempt, as an address may drop packets."""
    deadline, pause = monotonic() + timeout, 0.1
    while True:
        for each in network.connect:
            try:
                settings = zenoh_config(replace(network, connect=(each,)), CONNECT_TIMEOUT)
                settings["connect"]["retry"]["period_init_ms"] = 0  # a single attempt; no session that stays has this
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


@contextmanager
def _errors_explained(network: Network) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        if "os error 24" in str(error):
            raise DreamfleetError(_NO_ROOM.format(_first_line(error))) from error
        raise _connection_error(network, error) from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # raised if Zenoh runs out of threads or descriptors
            raise
        raise DreamfleetError(_NO_ROOM.format(_first_line(error))) from error


def zenoh_config(network: Network, timeout: float | None, dictionary: str | None = None) -> dict[str, Any]:
    """Zenoh's configuration for `network`; `zenohd` can read a router's too.

    With credentials it contains their secrets; `dictionary` is the path of the users' password file.
    """
    router, credentials = bool(network.listen), network.credentials
    room = connection_budget()  # else unknown senders' connections could use up the descriptors for files
    bounds = {"max_sessions": min(MAX_SESSIONS, room * 3 // 4), "accept_pending": min(MAX_SESSIONS, room // 4)}
    handshake = "" if credentials is None else f"#tls_handshake_timeout_ms={int(1000 * CONNECT_TIMEOUT)}"
    transport: dict[str, Any] = {
        "unicast": bounds if router else {},
        "shared_memory": {"enabled": False},
        "link": {
            "rx": {"max_message_size": MAX_RECEIVED},
            "tx": {
                "lease": LEASE_MS,
                "keep_alive": 4,
                "queue": {
                    "size": {"data": SEND_QUEUE},
                    "congestion_control": {
                        "drop": {"wait_before_drop": DROP_TIMEOUT},
                        "block": {"wait_before_close": 500_000},
                    },
                },
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
            own = credentials.password or derive_password(credentials.secret, credentials.identity)
            others = {"dictionary_file": dictionary} if dictionary else {}
            transport["auth"] = {"usrpwd": {"user": credentials.identity, "password": own, **others}}
        if router:
            guards["access_control"] = access_control_config(credentials.uses_passwords, network.revoked_seats)
    retry = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
    return {
        "mode": "router" if router else "client",
        "listen": {
            "endpoints": [with_interface_index(each) + handshake for each in network.listen],
            "exit_on_failure": True,
        },
        "connect": {
            "endpoints": [with_interface_index(each) for each in network.connect],
            "timeout_ms": -1 if timeout is None else int(timeout * 1000),
            "exit_on_failure": timeout is not None,
            "retry": retry,
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": False},  # Zenoh panics where the wall clock is before 1970 or after 2105
        "transport": transport,
        **guards,
    }


def _tls(credentials: Credentials) -> dict[str, Any]:
    """TLS settings: both ends show certificates; with passwords only the listening end does."""
    settings = {"root_ca_certificate_base64": _base64(credentials.ca), "enable_mtls": not credentials.uses_passwords,
                "verify_name_on_connect": True, "close_link_on_expiration": True}  # fmt: skip
    if credentials.certificate:
        for side in ("listen", "connect"):
            settings[f"{side}_certificate_base64"] = _base64(credentials.certificate)
            settings[f"{side}_private_key_base64"] = _base64(credentials.key)
    return settings


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


@contextmanager
def _password_file(network: Network) -> Iterator[str | None]:
    """Yield the path of a private temporary file of the users' passwords, which Zenoh reads as it opens, or `None`."""
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
        f"no one answers at {', '.join(network.connect)}: start `dreamfleet coordinator` or `dreamfleet router` "
        f"there, or name another address with --connect {protocol}HOST:PORT"
    )


def _first_line(error: BaseException) -> str:
    """What Zenoh says, without the places in its source, such as ` at /root/.cargo/...`."""
    return str(error).splitlines()[0].partition(" at /")[0][:200]


def enqueue_into(inbox: queue.SimpleQueue[Any], kind: str, max_waiting: int | None = None) -> Callable[[Any], None]:
    """A Zenoh callback that only enqueues `(kind, event)`, as a slow callback blocks the session.

    Drops events while `max_waiting` are queued, for messages that are repeated anyway.
    """

    def enqueue(event: Any) -> None:
        if max_waiting is None or inbox.qsize() < max_waiting:
            inbox.put((kind, event))

    return zenoh.handlers.Callback(enqueue, indirect=False)
