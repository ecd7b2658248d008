import json
import logging
import socket
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import pytest
import zenoh

from dreamfleet.common.addons.access.authority import Authority
from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.security.connection_limiter import MAX_UNAUTHENTICATED
from dreamfleet.common.security.credentials import read_join_file
from dreamfleet.common.transport.session import Network, open_session, zenoh_config
from tests.support.processes import DEADLINE, free_port, until


def knock(port, count):
    for _ in range(count):
        with socket.socket() as link:
            link.setblocking(False)
            link.connect_ex(("127.0.0.1", port))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="a filter of Linux's kernel")
def test_many_unauthenticated_connections_delay_only_new_ones(tmp_path, caplog):
    authority, port = Authority.create(tmp_path / "access"), free_port()
    authority.issue("coordinator", "home", tmp_path / "home.join")
    authority.issue("viewer", "eye", tmp_path / "eye.join", connect=["tls/127.0.0.1:7447"])
    endpoint = f"tls/127.0.0.1:{port}"
    viewer = Network(connect=(endpoint,), credentials=read_join_file(tmp_path / "eye.join"))
    caplog.set_level(logging.WARNING, "dreamfleet.router")
    home = Network(listen=(endpoint,), credentials=read_join_file(tmp_path / "home.join"))
    with open_session(home) as router:
        with open_session(viewer):
            inside = router.info.transports()
            knock(port, 2 * MAX_UNAUTHENTICATED)
            until(lambda: "crowd" in [getattr(each, "facts", {}).get("event") for each in caplog.records], "no crowd")
            assert [each.zid for each in router.info.transports()] == [each.zid for each in inside]
        until(lambda: joined(viewer), "a newcomer is not let in")
        many = 2 * MAX_UNAUTHENTICATED  # who proves something is no crowd
        with ExitStack() as fleet, ThreadPoolExecutor(many) as threads:
            for session in threads.map(lambda _: open_session(viewer, timeout=DEADLINE), range(many)):
                fleet.enter_context(session)
            assert joined(viewer)
    open_session(home).close()  # its port is free


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="descriptors of this process are found in /proc")
@pytest.mark.parametrize("mode", ["router", "peer"])
def test_only_seats_that_listen_take_part_as_routers(tmp_path, caplog, mode):
    authority, port = Authority.create(tmp_path / "access"), free_port()
    files = {}
    for role in ("coordinator", "router", "worker"):
        connect = [] if role == "coordinator" else ["tls/127.0.0.1:7447"]
        authority.issue(role, role, tmp_path / role, connect=connect)
        files[role] = read_join_file(tmp_path / role)
    endpoint = f"tls/127.0.0.1:{port}"
    caplog.set_level(logging.WARNING, "dreamfleet.router")

    def facts():
        return [getattr(each, "facts", {}) for each in caplog.records]

    def sessions(whatami):
        return sum(str(each.whatami) == whatami for each in home.info.transports())

    with ExitStack() as stack:
        home = stack.enter_context(open_session(Network(listen=(endpoint,), credentials=files["coordinator"])))
        stack.enter_context(open_session(Network(connect=(endpoint,), credentials=files["worker"])))
        far = Network(listen=(f"tls/127.0.0.1:{free_port()}",), connect=(endpoint,), credentials=files["router"])
        stack.enter_context(open_session(far, timeout=None))
        until(lambda: sessions("router") == 1, "the other router is not linked")
        settings = zenoh_config(Network(connect=(endpoint,), credentials=files["worker"]), DEADLINE)
        settings |= {"mode": mode, "listen": {"endpoints": []}}
        stack.enter_context(zenoh.open(zenoh.Config.from_json5(json.dumps(settings))))
        until(lambda: any(each.get("identity") == "worker.1" for each in facts()), "it is not noticed")
        until(lambda: sessions("peer") == 0 and sessions("router") == 1, "it stays")
        assert sessions("client") == 1
        assert len(facts()) == 1


def joined(network):
    try:
        open_session(network).close()
    except ConnectionFailedError:
        return False
    return True
