"""Join files: issued by an authority, validated strictly, and private; one that was edited, or is used while the clock
is wrong, is found before it is used. Connections are limited.
Tests connection_limiter.py, handshake.py, common/addons/access/authority.py and certificate_ledger.py."""

import errno
import json
import logging
import os
import re
import shlex
import shutil
import socket
import stat
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import count, product
from pathlib import Path
from threading import Event

import pytest
import zenoh

from dreamfleet.common.addons.access import authority
from dreamfleet.common.addons.access.authority import Authority, format_join_file, save_ledger, with_revoked
from dreamfleet.common.addons.doctor.health import _check_join_file
from dreamfleet.common.addons.router import verb as router
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import AccessError, ConnectionFailedError, DreamfleetError, UsageError
from dreamfleet.common.security import certificate_ledger
from dreamfleet.common.security.certificate_ledger import LEDGER_FILE, CertificateLedger, RevocationWatcher
from dreamfleet.common.security.connection_limiter import MAX_UNAUTHENTICATED, _end
from dreamfleet.common.security.credentials import (
    MAX_BYTES,
    SEATS,
    add_seat_to_name,
    issue_command,
    read_join_file,
    worker_seat_identity,
)
from dreamfleet.common.security.handshake import (
    EXPIRED,
    NOT_YET_VALID,
    check_certificate,
    describe_clock_error,
    diagnose_connection,
)
from dreamfleet.common.transport.network import Network
from dreamfleet.common.transport.session import open_session, zenoh_config
from tests.support.access import Access
from tests.support.processes import DEADLINE, free_port, until

HERE = ["tls/127.0.0.1:7447"]


@pytest.fixture(scope="module")
def access(tmp_path_factory):
    before = os.umask(0)  # whatever it is, nothing that is secret is anybody else's
    try:
        authority = Authority.create(tmp_path_factory.mktemp("keys") / "access")
        authority.issue("worker", "box", authority._folder / "box.join", connect=HERE)
    finally:
        os.umask(before)
    return authority


@pytest.fixture
def join(access, tmp_path):
    path = tmp_path / "box.join"
    path.write_bytes((access._folder / "box.join").read_bytes())
    path.chmod(0o600)
    return path


def test_an_authoritys_files_are_private_and_a_join_file_identifies_its_holder(access, join):
    found = read_join_file(join)
    assert (found.role, found.name, found.connect, found.identity) == ("worker", "box", tuple(HERE), "worker.1")
    assert "PRIVATE KEY" in found.key
    assert "BEGIN" not in repr(found)
    assert add_seat_to_name("gpu", found) == "gpu.1"
    assert add_seat_to_name("x" * 63, found) == "x" * 61 + ".1"
    assert worker_seat_identity("gpu.1/0badc0de") == "worker.1"
    served = replace(found, role="coordinator", seat=2)
    assert worker_seat_identity(f"{add_seat_to_name('gpu', served)}/0badc0de") == served.identity
    assert stat.S_IMODE(access._folder.stat().st_mode) == 0o700
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in access._folder.iterdir() if path.name != "lock"}
    assert modes == dict.fromkeys(("ca.pem", "ca.key", "issued.json", "box.join"), 0o600)


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "",
        lambda text: "not = [toml",
        lambda text: text + "#" * MAX_BYTES,
        lambda text: text + 'more = "x"\n',
        lambda text: text.partition("certificate =")[0],
        *((lambda text, old=old, new=new: text.replace(old, new)) for old, new in (
            ("version = 1", "version = 2"), ('role = "worker"', 'role = "king"'), ("seat = 1", "seat = 0"),
            ("seat = 1", 'seat = "1"'), ("Z\nconnect", "\nconnect"), ("name =", "nom ="),
            ('["tls/127.0.0.1:7447"]', "[1]"))),
    ],
)  # fmt: skip
def test_an_invalid_join_file_is_an_error_that_names_it_without_its_secret(join, damage):
    join.write_text(damage(join.read_text()))
    with pytest.raises(AccessError, match=re.escape(str(join))) as refused:
        read_join_file(join)
    assert "BEGIN" not in str(refused.value)


def test_a_readable_expired_or_invalid_join_file_is_refused(access, join, tmp_path):
    old = tmp_path / "old.join"
    access.issue("worker", "old", old, connect=HERE, days=1, now=datetime.now(UTC) - timedelta(days=2))
    for path in (old, tmp_path / "nowhere", tmp_path):
        with pytest.raises(AccessError, match=re.escape(str(path))):
            read_join_file(path)
    for mode in (0o640, 0o604):
        join.chmod(mode)
        with pytest.raises(AccessError, match="600"):
            read_join_file(join)


def test_a_name_keeps_its_seat_until_revoked_and_seats_are_not_reused(access, tmp_path):
    seats = [access.issue("viewer", "anna", tmp_path / f"{number}", connect=HERE).seat for number in range(2)]
    access.revoke("anna")
    seats.append(access.issue("viewer", "anna", tmp_path / "2", connect=HERE).seat)
    seats.append(access.issue("viewer", "ben", tmp_path / "3", connect=HERE).seat)
    assert seats == [1, 1, 2, 3]
    with pytest.raises(UsageError, match="--out"):
        access.issue("viewer", "ben", tmp_path / "3", connect=HERE)
    with pytest.raises(UsageError, match="carl"):
        access.revoke("carl")


@pytest.fixture
def revoked(access, tmp_path):
    """The folder of a ledger in which the worker `box` is revoked."""
    folder = tmp_path / "revoked"
    folder.mkdir()
    ledger = CertificateLedger.load(access._folder / LEDGER_FILE)
    save_ledger(with_revoked(ledger, [each for each in ledger.issued if each.name == "box"], 1.0), folder)
    return folder


def test_a_revocation_is_seen_and_final_whatever_becomes_of_the_ledger(access, join, revoked, tmp_path):
    folder, own = tmp_path / "carried", read_join_file(join)
    ledger, older = folder / LEDGER_FILE, access._folder / LEDGER_FILE
    watched = RevocationWatcher(folder, own)
    assert not watched.revoked_seats
    revoked.rename(folder)
    for now, harm in enumerate((lambda: None, lambda: ledger.write_text("{"), lambda: shutil.copy(older, ledger))):
        harm()
        watched.reload_if_changed(10.0 * now)
        assert "worker.1" in watched.revoked_seats
    ledger.unlink()
    watched.reload_if_changed(30.0)
    assert "worker.1" in watched.revoked_seats
    ledger.write_text("{")
    with pytest.raises(AccessError, match=LEDGER_FILE):  # who begins with it would let everybody in
        RevocationWatcher(folder, own)
    save_ledger(replace(CertificateLedger.load(older), authority="0" * 64), ledger.parent)
    with pytest.raises(AccessError, match="--access-dir"):
        RevocationWatcher(folder, own)


def test_what_is_known_to_be_revoked_stays_so_without_its_ledger_and_with_an_older_one(access, join, tmp_path):
    credentials, seats = replace(read_join_file(join), seat=2), frozenset({"worker.1"})
    for folder, kept, named in ((tmp_path, seats, False), (tmp_path, seats, True), (tmp_path, (), True)):
        with pytest.raises(AccessError):
            RevocationWatcher(folder, credentials, kept, named=named)
    older = RevocationWatcher(access._folder, credentials, seats)
    older.reload_if_changed(float("inf"))
    assert seats <= older.revoked_seats
    assert RevocationWatcher(tmp_path, None, seats).authority == ""


def test_a_ledger_that_could_not_be_read_is_read_later_and_warned_of_once(access, join, revoked, monkeypatch, caplog):
    watched = RevocationWatcher(access._folder, replace(read_join_file(join), seat=2))
    watched._path, watched._next = revoked / LEDGER_FILE, float("-inf")
    caplog.clear()  # of what other tests revoked
    with monkeypatch.context() as patched:
        patched.setattr(certificate_ledger, "read_regular", failing(errno.EMFILE))
        for now in (10.0, 20.0, 30.0):
            watched.reload_if_changed(now)
    assert "worker.1" not in watched.revoked_seats
    assert len(caplog.records) == 1
    watched.reload_if_changed(40.0)
    assert "worker.1" in watched.revoked_seats


def test_a_program_whose_own_file_is_revoked_or_over_goes_no_further(access, join, revoked, monkeypatch):
    own = read_join_file(join)
    with pytest.raises(AccessError):
        RevocationWatcher(revoked, own)
    with pytest.raises(AccessError):
        RevocationWatcher(access._folder, replace(own, expires=datetime.now(UTC)))
    monkeypatch.setattr(router, "CHECK_INTERVAL", 0.01)
    watched = RevocationWatcher(access._folder, own)
    watched._path, watched._next = revoked / LEDGER_FILE, float("-inf")
    with pytest.raises(AccessError):
        router.run_router(Network(listen=(f"tcp/127.0.0.1:{free_port()}",)), Event(), watched)


def test_the_verbs_create_list_and_revoke(tmp_path, capsys):
    out = tmp_path / "w.join"

    def access(*words):
        return main(["access", *words, "--access-dir", str(tmp_path / "access")])

    assert access("init") == 0
    assert access("issue", "worker", "w1", "--connect", *HERE, "--out", str(out)) == 0
    assert read_join_file(out).name == "w1"
    assert access("revoke", "w1") == 0
    said = capsys.readouterr().out
    assert access("list", "--json") == 0
    (row,) = json.loads(listed := capsys.readouterr().out)
    assert (row["name"], row["workers"], row["state"]) == ("w1", "*.1", "revoked")
    assert "BEGIN" not in said + listed
    assert access("init") == 2
    assert main(["pause", "--join", str(out)]) == 1
    assert "operator" in capsys.readouterr().err
    assert access("issue", "coordinator", "c", "--out", f"{out}2") == 2
    for endpoint in ("tcp/h:1", "tls/[::1]:1"):
        assert access("issue", "worker", "w2", "--connect", endpoint, "--out", f"{out}2") == 2
        assert endpoint in capsys.readouterr().err
    for host in ("h.example:7447", "tls/h.example", "", "a b", "a..b"):
        assert access("issue", "coordinator", "c", "--host", host, "--out", f"{out}2") == 2
        assert "--host" in capsys.readouterr().err
    assert access("issue", "coordinator", "home", "--host", "h.example", "--out", f"{out}2") == 0
    assert (read_join_file(f"{out}2").role, read_join_file(f"{out}2").connect) == ("coordinator", ())


def test_a_revoked_listener_of_a_fleet_with_passwords_is_said_to_know_them_all(tmp_path, capsys):
    for passwords, role in product((True, False), ("router", "worker")):
        folder, out = tmp_path / f"{passwords}", tmp_path / f"{passwords}-{role}.join"
        authority = Authority(folder) if folder.exists() else Authority.create(folder, passwords=passwords)
        authority.issue(role, role, out, connect=HERE)
        assert main(["access", "revoke", role, "--json", "--access-dir", str(folder)]) == 0
        assert json.loads(capsys.readouterr().out)["gives_all"] == (passwords and role == "router")


def test_an_authority_with_foreign_parts_issues_nothing(tmp_path):
    def made(name):
        return Authority.create(tmp_path / name, passwords=True)._folder

    whole, other = made("whole"), made("other")
    for part, text in (
        ("ca.key", (other / "ca.key").read_text()),
        (LEDGER_FILE, (other / LEDGER_FILE).read_text()),
        ("secret", "no hex"),
        ("secret", None),
    ):
        folder = tmp_path / "mixed"
        shutil.copytree(whole, folder)
        (folder / part).unlink()
        if text is not None:
            (folder / part).write_text(text)
        with pytest.raises(AccessError, match=re.escape(str(folder))):
            Authority(folder).issue("worker", "box", tmp_path / "box", connect=HERE)
        assert not (tmp_path / "box").exists()
        shutil.rmtree(folder)
    with (whole / "secret").open("a") as file:
        file.write("\n")  # as an editor leaves it
    Authority(whole).issue("coordinator", "home", tmp_path / "home", hosts=["h.example"])
    assert read_join_file(tmp_path / "home").secret == (whole / "secret").read_text().strip()


def failing(number):
    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    return fail


def test_a_full_disk_changes_nothing_and_an_unreadable_folder_is_an_error(access, join, tmp_path, monkeypatch):
    credentials, before = read_join_file(join), (access._folder / LEDGER_FILE).read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", failing(errno.ENOSPC))
        with pytest.raises(AccessError, match="No space left on device"):
            access.revoke("box")
    assert (access._folder / LEDGER_FILE).read_bytes() == before
    monkeypatch.setattr(Path, "stat", failing(errno.EACCES))
    for looked in (
        lambda: Authority(tmp_path),
        lambda: Authority.create(tmp_path),
        lambda: RevocationWatcher(tmp_path, credentials),
    ):
        with pytest.raises(AccessError, match="Permission denied"):
            looked()


@pytest.mark.parametrize("held", [(LEDGER_FILE,), ("ca.pem", LEDGER_FILE), ("secret",)])
def test_a_folder_with_a_part_of_an_authority_keeps_it(access, tmp_path, held):
    for name in held:
        (tmp_path / name).write_bytes(b"mine")
    with pytest.raises(UsageError, match=held[0]):
        Authority.create(tmp_path, passwords=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys(held, b"mine")


def test_an_authority_whose_making_failed_can_be_made_again(tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(authority, "_key_bytes", failing(errno.ENOSPC))
        with pytest.raises(DreamfleetError, match="No space left"):
            Authority.create(tmp_path, passwords=True)
    Authority.create(tmp_path, passwords=True)


def test_a_list_keeps_what_is_valid_or_revoked_or_a_names_last_and_never_grows_too_large(tmp_path, monkeypatch):
    made, numbers = Authority.create(tmp_path / "access"), count()

    def issue(name, age=0):
        when = datetime.now(UTC) - timedelta(days=age)
        return made.issue("worker", name, tmp_path / str(next(numbers)), connect=HERE, days=2, now=when).seat

    def listed():
        return [(each.name, each.seat) for each in CertificateLedger.load(path).issued]

    path = made._folder / LEDGER_FILE
    issue("gone", age=3)
    made.revoke("gone")
    for name, age in (("gone", 3), ("old", 6), ("old", 3), ("new", 0), ("new", 1)):
        issue(name, age)
    assert listed() == [("gone", 1), ("gone", 2), ("old", 3), ("new", 4), ("new", 4)]
    assert issue("gone") == 2
    monkeypatch.setattr(authority, "MAX_BYTES", path.stat().st_size)
    before = listed()
    with pytest.raises(AccessError, match=LEDGER_FILE):
        issue("next")
    assert listed() == before
    made.revoke("old")
    assert len(list(tmp_path.iterdir())) == next(numbers)  # the folder, and a file for each that was issued


def test_commands_at_once_wait_for_each_other(access, tmp_path):
    with ThreadPoolExecutor(8) as pool:
        issued = list(pool.map(lambda n: access.issue("worker", f"w{n}", tmp_path / f"{n}", connect=HERE), range(8)))
        again = [pool.submit(access.issue, "worker", f"w{n}", tmp_path / "one", connect=HERE) for n in range(8)]
    assert len({each.seat for each in issued}) == 8
    failures = [type(each.exception()) for each in again if each.exception()]
    assert failures == [UsageError] * 7, "a file is written once"


@pytest.mark.parametrize(("name", "mode"), [("", 0o702), ("ca.key", 0o640), ("ca.key", 0o604), ("issued.json", 0o602)])
def test_an_authority_that_others_may_change_issues_nothing(tmp_path, name, mode):
    folder = tmp_path / "access"
    folder.mkdir()
    if not name:
        folder.chmod(mode)
        with pytest.raises(AccessError, match=re.escape(str(folder))):
            Authority.create(folder)
        folder.chmod(0o700)
    Authority.create(folder)
    path = folder / name
    path.chmod(mode)
    with pytest.raises(AccessError, match=re.escape(str(path))):
        Authority(folder)
    path.chmod(0o700)
    Authority(folder)
    if os.geteuid() == 0:  # who alone gives files away
        os.chown(path, 65534, -1)
        with pytest.raises(AccessError, match=re.escape(str(path))):
            Authority(folder)


def test_an_existing_authority_is_not_overwritten_even_in_a_race(tmp_path, monkeypatch):
    folder = tmp_path / "access"
    begun = authority._certify

    def late(*args, **more):
        monkeypatch.setattr(authority, "_certify", begun)
        Authority.create(folder)
        return begun(*args, **more)

    monkeypatch.setattr(authority, "_certify", late)
    with pytest.raises(UsageError, match="--access-dir"):
        Authority.create(folder)
    Authority(folder)


@pytest.mark.parametrize(("ca", "host"), [("garbage", "127.0.0.1"), ("gärbage", "127.0.0.1"), ("", "a" * 70)])
def test_damage_is_an_error_without_traceback(join, ca, host):
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tls/{host}:{server.getsockname()[1]}"
        said = diagnose_connection([endpoint], replace(read_join_file(join), ca=ca))
    assert (said is None) == (host != "127.0.0.1")


ROLES = ("coordinator", "first", "viewer", "operator")


@pytest.fixture(scope="module")
def seats(tmp_path_factory):
    return Access(tmp_path_factory.mktemp("keys") / "access")


def test_what_was_issued_is_in_order(seats, tmp_path):
    for issued in (seats, Access(tmp_path / "access", passwords=True)):
        assert {check_certificate(read_join_file(issued.path(each))) for each in ROLES} == {None}


def test_each_field_that_the_certificate_has_too_must_agree(seats, tmp_path):
    other = Access(tmp_path / "access")
    for whole, foreign in ((read_join_file(each.path(who)) for each in (seats, other)) for who in ROLES):
        edits = [
            {"seat": whole.seat + 1},
            {"role": "router"},
            {"expires": whole.expires + timedelta(days=1)},
            {"ca": foreign.ca},
            {"key": foreign.key},
            {"ca": ""},
            {"key": ""},
            {"certificate": whole.certificate[:300]},
            {"ca": "gärbage", "certificate": "x"},
        ]
        for edit in edits:
            with pytest.raises(AccessError):
                check_certificate(replace(whole, **edit))
        check_certificate(replace(whole, connect=("tls/elsewhere.example:7447",), name="renamed"))


@pytest.mark.parametrize("verb", ["coordinator", "worker", "status", "router"])
def test_every_verb_refuses_an_edited_file(seats, tmp_path, capsys, verb):
    whole = read_join_file(seats.path("first" if verb == "worker" else "coordinator"))
    path = tmp_path / "edited.join"
    path.touch(mode=0o600)
    role = "router" if verb == "router" else whole.role
    path.write_text(format_join_file(replace(whole, seat=7, role=role)))
    assert main([verb, "--join", str(path)]) == 1
    assert f"{whole.role}.{whole.seat}" in capsys.readouterr().err
    found = [_check_join_file(each) for each in (path, seats.path("first"))]  # by `doctor`
    assert [(each.ok, each.needed) for each in found] == [(False, True), (True, False)]


@pytest.mark.parametrize("role", SEATS)
@pytest.mark.parametrize("connect", [(), ("tls/h.example:7447", "tls/far.example:1")])
def test_the_command_that_an_error_names_issues_a_file(tmp_path, role, connect):
    Authority.create(tmp_path / "access")
    words = shlex.split(issue_command(role, "box", connect).replace("FILE", str(tmp_path / "join")))
    assert main([*words[1:], "--access-dir", str(tmp_path / "access")]) == 0
    made = read_join_file(tmp_path / "join")
    assert made.role == role
    assert made.connect == connect or not connect


@pytest.mark.parametrize("days", [-91, 3])
def test_a_wrong_clock_is_called_that(seats, tmp_path, days):
    now = datetime.now(UTC) + timedelta(days=days)
    issued = seats.authority.issue("viewer", "early", tmp_path / "join", connect=["tls/h.example:1"], now=now)
    with pytest.raises(AccessError) as refused:
        check_certificate(issued)
    cause = refused.value.__cause__
    assert cause.verify_code in (NOT_YET_VALID, EXPIRED)
    assert describe_clock_error(cause)
    assert describe_clock_error(cause).partition(",")[0] in str(refused.value)  # but for the minute


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
            for _ in range(2 * MAX_UNAUTHENTICATED):
                with socket.socket() as link:
                    link.setblocking(False)
                    link.connect_ex(("127.0.0.1", port))
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
@pytest.mark.parametrize(
    ("who", "mode"), [("worker.1", "router"), ("worker.1", "peer"), ("router.2", "router"), ("coordinator.2", "router")]
)
def test_only_valid_seats_that_listen_take_part_as_routers(tmp_path, caplog, who, mode):
    authority, port = Authority.create(tmp_path / "access"), free_port()
    files = {}
    for role, number in (("coordinator", 1), ("router", 1), ("worker", 1), ("router", 2), ("coordinator", 2)):
        name = f"{role}.{number}"
        authority.issue(role, name, tmp_path / name, connect=["tls/127.0.0.1:7447"])
        files[name] = read_join_file(tmp_path / name)
    revoked = frozenset(("router.2", "coordinator.2"))
    endpoint = f"tls/127.0.0.1:{port}"
    caplog.set_level(logging.WARNING, "dreamfleet.router")

    def facts():
        return [getattr(each, "facts", {}) for each in caplog.records]

    def sessions(whatami):
        return sum(str(each.whatami) == whatami for each in home.info.transports())

    with ExitStack() as stack:
        own = Network(listen=(endpoint,), credentials=files["coordinator.1"], revoked_seats=revoked)
        home = stack.enter_context(open_session(own))
        stack.enter_context(open_session(Network(connect=(endpoint,), credentials=files["worker.1"])))
        far = Network(listen=(f"tls/127.0.0.1:{free_port()}",), connect=(endpoint,), credentials=files["router.1"])
        stack.enter_context(open_session(far, timeout=None))
        until(lambda: sessions("router") == 1, "the other router is not linked")
        settings = zenoh_config(Network(connect=(endpoint,), credentials=files[who]), DEADLINE)
        settings |= {"mode": mode, "listen": {"endpoints": []}}
        stack.enter_context(zenoh.open(zenoh.Config.from_json5(json.dumps(settings))))
        until(lambda: any(each.get("identity") == who for each in facts()), "it is not noticed")
        until(lambda: sessions("peer") == 0 and sessions("router") == 1, "it stays")
        assert sessions("client") == 1
        assert len(facts()) == 1


def test_an_end_of_a_connection_is_the_same_however_its_interface_is_written():
    assert _end("[fe80::1%eth0]:5") == _end("[fe80::1%4]:5") == ("fe80::1", "5")
    assert _end("[::ffff:127.0.0.1]:5") == _end("[127.0.0.1]:5") == _end("127.0.0.1:5") == ("127.0.0.1", "5")


def joined(network):
    try:
        open_session(network).close()
    except ConnectionFailedError:
        return False
    return True
