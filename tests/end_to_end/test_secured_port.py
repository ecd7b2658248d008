"""Who does what at a secured port, with a join file or without one, or at an open port: it costs no bit.

At an open port the attacker has a session of Zenoh and nothing else: it overhears names, lives, nonces, batches and
fingerprints. What rules cannot hold off is not here: docs/explanation/threats.md names it.

Tests common/security/access_rules.py, common/security/connection_limiter.py, coordinator/dispatch/fleet.py and
worker/service/backlog.py.
"""

import resource
import socket
import ssl
from pathlib import Path

import pytest

from dreamfleet.common.client.client import Client
from dreamfleet.common.transport.session import Network
from tests.support import tasks
from tests.support.access import begin, work
from tests.support.attacks import CLAIMED, OPEN, RUN, SECURED, SETTINGS, attacking, outcome, steers_by_name
from tests.support.processes import until

# What arrives of each, and is counted: nothing of who only looks or steers; of a worker what it says in its own name.
ARRIVES = {
    "viewer": set(),
    "operator": set(),
    "second": {"result of a job that was not given", "lease with more steps than a job has"},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "who", [*(pytest.param(who, marks=pytest.mark.long) for who in ("viewer", "operator")), "second"]
)
def test_all_at_once_change_no_bit(processes, access, endpoint, random_bundle, unharmed, who):
    actions = SECURED if who == "operator" else [*SECURED, steers_by_name]  # which an operator may
    coordinator = begin(processes, access, endpoint, random_bundle, *SETTINGS, name=RUN)
    ears = access.network("coordinator", endpoint)
    with attacking(access.network(who, endpoint), *actions, ears=ears) as evil:
        work(processes, access, endpoint, "first", RUN, "--name", "own")
        assert coordinator.finish()[0] == 0
    assert outcome(processes) == unharmed, "\n".join(coordinator.lines)
    assert not evil.steered
    assert not evil.asked
    assert not evil.overheard
    assert evil.seen
    assert evil.seen.isdisjoint(CLAIMED)
    assert evil.dropped.keys() - {"result of an unknown worker"} == ARRIVES[who]
    assert ARRIVES[who] or not evil.dropped
    assert not coordinator.events("paused")


def address(endpoint):
    host, port = endpoint.partition("/")[2].split(":")
    return host, int(port)


def knock(where, count):
    """Connections that are begun and closed at once; nobody waits for an answer."""
    for _ in range(count):
        with socket.socket() as link:
            link.setblocking(False)
            link.connect_ex(where)


def break_off(where, count):
    """Handshakes that end with the first words."""
    context = ssl.create_default_context()
    for _ in range(count):
        incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        with pytest.raises(ssl.SSLWantReadError):
            context.wrap_bio(incoming, outgoing, server_hostname="home.example").do_handshake()
        with socket.socket() as link:
            link.settimeout(0.05)
            if not link.connect_ex(where):
                link.send(outgoing.read())


def hold(where, count):
    """Connections that say nothing and stay."""
    held = [socket.socket() for _ in range(count)]
    for link in held:
        link.setblocking(False)
        link.connect_ex(where)
    return held


def open_files(process):
    return len(list(Path(f"/proc/{process.popen.pid}/fd").iterdir()))


@pytest.mark.long
def test_ten_thousand_connections_that_prove_nothing_keep_nobody_out_for_long(
    processes, access, endpoint, random_bundle, unharmed
):
    if resource.getrlimit(resource.RLIMIT_NOFILE)[0] < 3000:
        pytest.skip("2,000 connections at once want more descriptors (ulimit -n)")
    coordinator = begin(processes, access, endpoint, random_bundle, *SETTINGS, name=RUN)
    with Client(access.network("viewer", endpoint)) as viewer:
        before, where = open_files(coordinator), address(endpoint)
        held = hold(where, 2000)
        knock(where, 10_000)
        break_off(where, 200)
        assert open_files(coordinator) > before
        assert viewer.status().state == "waiting for workers"  # who is in, stays in
        work(processes, access, endpoint, "first", RUN, "--name", "own").wait_for_event("joined")
        assert coordinator.finish()[0] == 0
    for link in held:
        link.close()
    assert outcome(processes) == unharmed


@pytest.mark.long
def test_strangers_take_no_descriptor_for_good(processes, access, endpoint, random_bundle):
    """More connections than the process may have; Zenoh alone would never end one, nor accept any other."""
    coordinator = begin(processes, access, endpoint, random_bundle, "--generations", 1,
                        inside=("bash", "-c", 'ulimit -n 120; exec "$@"', "-"))  # fmt: skip
    before, held = open_files(coordinator), hold(address(endpoint), 400)
    coordinator.wait_for_event("crowd")
    for link in held:
        link.close()
    until(lambda: open_files(coordinator) <= before, "descriptors do not come back")
    work(processes, access, endpoint, "first").wait_for_event("joined")
    assert coordinator.finish()[0] == 0


def connects_without_end(evil, number):
    if number < 5:
        for _ in range(200):
            socket.create_connection(address(evil.endpoint)).close()


ACTIONS = [*OPEN, connects_without_end]


def harmed(processes, random_bundle, *actions):
    coordinator = processes.coordinator("--bundle", random_bundle.path, *SETTINGS)
    with attacking(Network(connect=(processes.endpoint,)), *actions) as evil:
        processes.worker("--task", tasks.SLOW_TOY, "--name", "own")
        assert coordinator.finish()[0] == 0
    assert not evil.steered
    return evil, coordinator


@pytest.mark.slow
def test_at_an_open_port_all_at_once_change_no_bit(processes, random_bundle, unharmed):
    evil, coordinator = harmed(processes, random_bundle, *ACTIONS)
    assert outcome(processes) == unharmed, "\n".join(coordinator.lines)
    assert evil.dropped.keys() >= {
        "result of an unknown worker", "result of a job that was not given", "lease with more steps than a job has",
    }  # fmt: skip
    assert len(evil.dropped) > 3  # a result of another fingerprint than its worker's too
    assert not coordinator.events("paused")


@pytest.mark.long
@pytest.mark.parametrize("action", ACTIONS, ids=lambda action: action.__name__)
def test_each_alone_changes_no_bit(processes, random_bundle, unharmed, action):
    harmed(processes, random_bundle, action)
    assert outcome(processes) == unharmed
