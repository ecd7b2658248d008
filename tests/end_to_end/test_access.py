"""A fleet with join files: who is let in, who may do what, and that a run is none the worse for the others.
Tests common/security/access_rules.py, common/addons/access/verb.py, coordinator/storage/kept_revocations.py,
common/security/handshake.py and common/security/certificate_ledger.py."""

import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
import zenoh

from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, HandshakeRejectedError
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode, encode_json
from dreamfleet.common.security.credentials import read_join_file
from dreamfleet.common.transport.session import MAX_FORWARDED, Network, open_session
from dreamfleet.coordinator.addons.dashboard.live_runs import Watcher
from dreamfleet.worker.service.admission import make_request
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.worker import Worker
from tests.support import tasks
from tests.support.access import Access, begin, work
from tests.support.processes import DEADLINE, free_port, until
from tests.support.relay import Relay
from tests.support.same_bits import outcome
from tests.support.samples import MSGPACK
from tests.support.stage import drained, listening, wait_for

LIFE = "0badc0de"
LEFT = 60  # seconds of a certificate that ends while a run is served


@pytest.mark.slow
def test_each_may_do_what_its_role_says_and_the_run_is_none_the_worse(
    processes, access, endpoint, small, random_bundle
):
    plain = processes.coordinator(*small, "--generations", 3, name="plain")
    processes.worker("--task", tasks.SLOW_TOY)
    coordinator = begin(processes, access, endpoint, random_bundle, "--generations", 3)
    own, foreign, garbage = f"x.1/{LIFE}", f"x.2/{LIFE}", b"\xc1"  # `first` has seat 1
    asks = {
        "status": keys.status("safe"), "best": keys.status("safe", "best"),
        "bundle": keys.bundle("safe", random_bundle.sha256), "pause": keys.control("safe", "pause"),
        "hello": keys.hello("safe"), "own hello": keys.secured_hello("safe", own),
        "another's hello": keys.secured_hello("safe", foreign),
    }  # fmt: skip
    expected = {
        "first": {"status", "bundle", "own hello"},
        "viewer": {"status", "best"},
        "operator": {"status", "best", "bundle", "pause"},
    }
    may, heard = {who: set() for who in expected}, []
    with Client(access.network("operator", endpoint)) as operator:
        hello = encode_json(make_request(own, (tasks.SLOW_TOY,), 1))
        with ExitStack() as stack:
            sessions = {who: stack.enter_context(open_session(access.network(who, endpoint)))
                        for who in ("first", "viewer", "operator")}  # fmt: skip
            kept = []
            for who, session in sessions.items():
                for kind in (keys.result, keys.heartbeat, keys.upload):
                    session.put(kind("safe", foreign), garbage)
                session.put(keys.job("safe", own), encode(MSGPACK["job"]))
                session.put(keys.event_status("safe"), garbage)
                kept.append(session.declare_subscriber(keys.job("safe", foreign), heard.append))
                kept.append(session.liveliness().declare_token(keys.live_worker("safe", foreign)))
                for name, key in asks.items():  # what is not allowed is answered by nobody

                    def answered(reply, who=who, name=name):
                        may[who] |= {name} if reply.ok else set()

                    session.get(key, answered, payload=hello, timeout=DEADLINE)
            until(lambda: all(may[who] >= expected[who] for who in may), "an answer to what is allowed")
            # What may be said arrives, and nothing that was said before it.
            sessions["first"].put(keys.result("safe", own), garbage)
            sessions["first"].put(keys.result("safe", own), bytes(MAX_FORWARDED + 1))
            until(lambda: operator.status().dropped, "what a worker may say")
            for each in kept:
                each.undeclare()
        assert may == expected
        assert operator.status().dropped == {"not msgpack": 1}
        assert operator.status().state == "paused"
        assert not heard
        operator.control("safe", "resume")
        worker = work(processes, access, endpoint, "first")
        until(lambda: operator.workers("safe"), "the worker in the list")
        assert {each.worker.split("/")[0].rpartition(".")[2] for each in operator.workers("safe")} == {"1"}
        assert operator.status().expires > time.time() + 80 * 86400
        until(lambda: not operator.runs(), "the end of the run")
    assert coordinator.finish()[0] == 0
    assert plain.finish()[0] == 0
    assert outcome(processes, "safe") == outcome(processes, "plain")
    body = read_join_file(access.path("coordinator")).key.splitlines()[1]
    assert not [path for path in (processes.runs / "safe").iterdir() if body.encode() in path.read_bytes()]
    assert not [line for line in (*coordinator.lines, *worker.lines) if body in line]
    assert (processes.runs / "safe").stat().st_mode & 0o077 == 0
    assert (processes.runs / "safe" / "journal.sqlite").stat().st_mode & 0o077 == 0


@pytest.mark.slow
def test_a_stranger_to_the_fleet_and_a_listener_out_of_its_time_are_refused(access, endpoint, tmp_path):
    def issued(role, days):
        now = datetime.now(UTC) + timedelta(days=days)
        return access.authority.issue(role, f"{role}{days}", tmp_path / f"{role}{days}", connect=[endpoint], now=now)

    def refused(where, credentials):
        with pytest.raises(HandshakeRejectedError):
            open_session(Network(connect=(where,), credentials=credentials), timeout=1)

    good, elsewhere = read_join_file(access.path("viewer")), f"tls/127.0.0.2:{free_port()}"
    with open_session(Network(listen=(endpoint,), credentials=issued("coordinator", -91))):
        refused(endpoint, good)
    with open_session(Network(listen=(endpoint, elsewhere), credentials=read_join_file(access.path("coordinator")))):
        refused(endpoint, read_join_file(Access(tmp_path / "other").path("viewer")))
        refused(endpoint, replace(good, certificate="", key=""))
        for days in (-91, 3):
            refused(endpoint, issued("viewer", days))
        refused(elsewhere, good)  # a wrong name
        open_session(Network(connect=(endpoint,), credentials=good)).close()
        plain = Network(connect=(endpoint.replace("tls", "tcp"),))
        with pytest.raises(HandshakeRejectedError, match="--join"):
            open_session(plain, timeout=1)
        assert b"--join" in Watcher(plain, None, tmp_path).poll().absent_event


@pytest.mark.slow
def test_a_worker_that_is_not_let_in_says_why_once_and_tries_again(access, endpoint, tmp_path):
    plain, other = Network(connect=(endpoint.replace("tls", "tcp"),)), Access(tmp_path / "other")
    with open_session(Network(listen=(endpoint,), credentials=read_join_file(access.path("coordinator")))):
        workers = [Worker(WorkerConfig(slots=1), each) for each in (plain, other.network("first", endpoint))]
        with listening() as said, ThreadPoolExecutor() as threads:
            serving = [threads.submit(each.serve) for each in workers]
            lines = [wait_for(said, "[rejected]") for _ in workers]
            for each in workers:
                each.stop()
        assert sum("--join" in line for line in lines) == 1, "to the one of another fleet it says something else"
        assert not [line for line in drained(said) if "[rejected]" in line]
        assert [each.result() for each in serving] == [None, None]


@pytest.mark.slow
def test_a_plain_port_and_a_closed_port_give_different_errors_for_a_join_file(access):
    plain, nobody = f"127.0.0.1:{free_port()}", f"127.0.0.1:{free_port()}"
    served = open_session(Network(listen=(f"tcp/{plain}",)))
    with served, pytest.raises(HandshakeRejectedError, match="--join"):
        open_session(access.network("viewer", f"tls/{plain}"), timeout=1)
    linked = Network((f"tls/{plain}",), (f"tls/{nobody}",), read_join_file(access.path("coordinator")))
    with pytest.raises(ConnectionFailedError, match=f"tls/{nobody}"):
        open_session(linked, timeout=1)


@pytest.mark.slow
def test_a_link_of_half_a_second_to_and_fro_lets_a_worker_in(processes, access, endpoint):
    begin(processes, access, endpoint, None)
    relay = Relay(int(endpoint.rpartition(":")[2]))
    relay.delay = 0.25
    try:
        work(processes, access, f"tls/127.0.0.1:{relay.port}", "first").wait_for_event("joined")
    finally:
        relay.close()


@pytest.mark.slow
def test_a_worker_that_is_revoked_counts_no_more_while_the_run_goes_on(processes, access, endpoint, random_bundle):
    seats = {}
    for name in ("fired", "newcomer"):
        seats[name] = access.authority.issue("worker", name, access.path(name), connect=[endpoint]).seat
        if name == "fired":  # the other one's file is made while the run is served
            coordinator = begin(processes, access, endpoint, random_bundle, "--generations", 10_000)
    work(processes, access, endpoint, "fired").wait_for_event("joined")
    coordinator.wait_for_event("generation", number=1)
    assert processes.call("access", "revoke", "fired", "--access-dir", access.folder)[0] == 0
    coordinator.wait_for(f"worker.{seats['fired']}")
    with Client(access.network("operator", endpoint)) as client:
        until(lambda: client.status().slots == 0, "a fleet without the worker")
        until(lambda: client.status().refused, "its refusal")
        work(processes, access, endpoint, "newcomer").wait_for_event("joined")
        before = client.status().generations
        until(lambda: client.status().generations > before + 1, "another generation")
        again = client.control("safe", "stop")
    coordinator.finish()
    assert again.endswith(f"--join {access.path('coordinator')} --access-dir {access.folder}")
    # Without the list, which the run's journal remembers, nobody is served: neither of the run nor of a copy of it.
    backup, fork = processes.folder / "backup", ("--run", "fork", "--from", "safe", "--generations", 1)
    out = processes.printed("runs", "backup", "safe", "--runs-dir", processes.runs, "--to", backup)
    assert "--join FILE --access-dir FOLDER" in out
    for runs, words in ((processes.runs, ("--resume", "safe")), (backup, ("--resume", "safe")), (processes.runs, fork)):
        call = ("coordinator", *words, "--runs-dir", runs, "--join", access.path("coordinator"))
        processes.refused("--access-dir", *call, code=1)


@pytest.mark.slow
def test_a_coordinator_whose_own_file_is_revoked_leaves_and_does_not_come_back(processes, tmp_path, endpoint):
    access = Access(tmp_path / "access")  # others need a coordinator's file that serves
    coordinator = begin(processes, access, endpoint, None, "--generations", 10_000)
    assert processes.call("access", "revoke", "home", "--access-dir", access.folder)[0] == 0
    assert coordinator.finish()[0] == 1
    assert f"--access-dir {access.folder}" in coordinator.last_line()
    flags = ("--join", access.path("coordinator"), "--access-dir", access.folder)
    assert processes.call("coordinator", "--resume", "safe", "--runs-dir", processes.runs, *flags)[0] == 1
    other = access.path("other")
    access.authority.issue("coordinator", "home", other)
    again = ("--join", other, "--access-dir", access.folder)
    processes.resume("safe", *again).wait_for_event("begin", incarnation=2)


def test_a_router_that_starts_after_it_bars_every_role(access, endpoint):
    network = Network(listen=(endpoint,), credentials=read_join_file(access.path("coordinator")),
                      revoked_seats=frozenset({"viewer.1", "operator.1", "worker.1"}))  # fmt: skip
    with open_session(network) as router, ExitStack() as stack:
        asks = [keys.status("safe"), keys.control("safe", "stop"), keys.bundle("safe", "ab" * 32)]
        sessions = {who: stack.enter_context(open_session(access.network(who, endpoint)))
                    for who in ("viewer", "operator", "first", "second")}  # fmt: skip
        for key in asks:
            stack.enter_context(router.declare_queryable(key, lambda query: query.reply(query.key_expr, b"{}")))
        until(lambda: answered(sessions["second"].get(asks[0], timeout=1)), "an answer to who is not barred")
        barred = [sessions[who].get(key, timeout=2) for who in ("viewer", "operator", "first") for key in asks]
        assert not any(map(answered, barred))


def answered(replies):
    return any(reply.ok for reply in replies)


@pytest.mark.slow
def test_a_worker_leaves_before_its_join_file_ends_and_says_so(processes, access, endpoint, random_bundle):
    begin(processes, access, endpoint, random_bundle, "--generations", 10_000)
    access.authority.issue("worker", "brief", access.path("brief"), connect=[endpoint], days=8 / 86400)
    worker = work(processes, access, endpoint, "brief", "safe", "--drain-timeout", 1)
    assert worker.finish()[0] == 1


@pytest.mark.slow
def test_a_fleet_is_joined_by_passwords_too(processes, tmp_path, endpoint, random_bundle):
    access = Access(tmp_path / "access", passwords=True)
    assert not read_join_file(access.path("first")).certificate
    coordinator = begin(processes, access, endpoint, random_bundle, "--generations", 1)
    viewer = access.network("viewer", endpoint)
    with Client(viewer) as client:
        assert client.status().state == "waiting for workers"
        assert not list(client.session.get(keys.control("safe", "stop"), timeout=2))
    for wrong in (replace(viewer.credentials, password="0" * 64), replace(viewer.credentials, role="operator")):
        with pytest.raises(ConnectionFailedError):
            open_session(replace(viewer, credentials=wrong), timeout=1)
    work(processes, access, endpoint, "first").wait_for_event("joined")
    assert coordinator.finish()[0] == 0


def test_nobody_listens_beyond_this_host_without_security_unless_that_is_said(processes, access):
    anywhere = f"tcp/0.0.0.0:{processes.port}"
    words = ("coordinator", "--run", "open", "--runs-dir", processes.runs, "--listen", anywhere)
    processes.refused("--insecure", *words)
    process = processes.start(*words, "--insecure")
    process.wait_for_event("insecure")
    process.end()
    processes.refused(f"tls/0.0.0.0:{processes.port}", *words, "--join", access.path("coordinator"))


@pytest.mark.slow
def test_a_coordinator_whose_certificate_ends_while_it_serves_leaves_and_so_does_its_worker(
    processes, tmp_path, endpoint
):
    access = Access(tmp_path / "access")
    own, ends = access.path("short"), datetime.now(UTC) + timedelta(seconds=LEFT)
    access.authority.issue("coordinator", "short", own, hosts=["home.example"], days=1, now=ends - timedelta(days=1))
    access.path("coordinator").unlink()
    own.rename(access.path("coordinator"))
    coordinator = begin(processes, access, endpoint, None, "--generations", 10_000)
    worker = work(processes, access, endpoint, "first", "safe", "--exit-when-done", "--coordinator-timeout", 1)
    worker.wait_for_event("joined")
    assert coordinator.finish()[0] == 1
    assert datetime.now(UTC) >= ends - timedelta(seconds=1)
    assert worker.finish()[0] == 1


@pytest.mark.slow
def test_a_router_links_to_those_that_its_join_file_names(processes, tmp_path, access, endpoint, random_bundle):
    near, joined = f"tls/127.0.0.1:{free_port()}", tmp_path / "near.join"
    access.authority.issue("router", "near", joined, connect=[endpoint], hosts=["near.example"])
    words = ("router", "--join", joined, "--access-dir", access.folder, "--listen", near)
    assert processes.start(*words).wait_for_event("begin")["connect"] == [endpoint]
    begin(processes, access, endpoint, random_bundle, "--generations", 1)
    with Client(access.network("viewer", near)) as viewer:
        until(viewer.runs, "a run behind the other router")


@contextmanager
def routed_by_the_verb(processes, *words):
    processes.start(*words).wait_for_event("begin")
    yield


@contextmanager
def routed_by_zenoh_alone(processes, *words):
    """From the file that zenohd reads."""
    file = processes.folder / "secured.json5"
    code, out, err = processes.call(*words, "--print-config")
    assert (code, out, "--write-config" in err) == (2, "", True)
    assert processes.call(*words, "--write-config", file)[0] == 0
    assert file.stat().st_mode & 0o777 == 0o600
    processes.refused(str(file), *words, "--write-config", file)
    with zenoh.open(zenoh.Config.from_file(str(file))):
        yield


@pytest.fixture(params=[routed_by_the_verb, routed_by_zenoh_alone], ids=lambda how: how.__name__)
def router(request, processes, tmp_path, access, endpoint):
    join = tmp_path / "router.join"
    access.authority.issue("router", "middle", join, hosts=["router.example"])
    words = ("router", "--join", join, "--access-dir", access.folder, "--listen", endpoint)
    with request.param(processes, *words) as routed:
        yield routed


@pytest.mark.slow
@pytest.mark.usefixtures("router")
def test_a_router_of_its_own_holds_everybody_to_the_same_rules(processes, access, endpoint, small):
    flags = ("--join", access.path("coordinator"), *small, "--generations", 1)
    coordinator = processes.coordinator(*flags, name="far", at=("--connect", endpoint))
    for who, may in (("viewer", False), ("operator", True)):
        with open_session(access.network(who, endpoint)) as session:
            replies = session.get(keys.control("far", "resume"), timeout=DEADLINE if may else 2)
            assert any(reply.ok for reply in replies) == may
    assert processes.call("pause", "far", "--join", access.path("viewer"), "--connect", endpoint)[0] == 1
    work(processes, access, endpoint, "second", name="far").wait_for_event("joined")
    assert coordinator.finish()[0] == 0
