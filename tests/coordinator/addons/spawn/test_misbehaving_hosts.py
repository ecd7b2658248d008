"""Hosts that answer nonsense, print without end or say nothing: each is one row, and the others go on.
Tests connection.py, parallel.py and remote_host.py."""

import re
import resource
import shlex
import stat
import sys
import time
from threading import Event
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.coordinator.addons.spawn import connection, parallel
from dreamfleet.coordinator.addons.spawn.config import Host, SpawnConfig
from dreamfleet.coordinator.addons.spawn.connection import NO_PYTHON, Connection, explain
from dreamfleet.coordinator.addons.spawn.parallel import check
from dreamfleet.coordinator.addons.spawn.remote_host import FAILED, FleetAddress, HostStatus
from tests.support.processes import DEADLINE

GOOD = 'os.execvp("/bin/sh", ["sh", "-c", sys.argv[-1]])\n'
LOOK = {
    "python": [3, 11], "executable": "p", "machine": "m", "system": "s", "installed": None, "venv": True,
    "writable": True, "noexec": False, "root": "r", "free": 1, "environments": [],
    "workers": [{"name": "a", "running": True, "slots": 1, "age": 1e300, "digest": None, "last": ""}],
}  # fmt: skip
READY = 'say("dreamfleet-host " + json.dumps({"ok": {}}))\n'
FORM = ""  # what is said of it is the same, whichever form it is; of others it names a request or an amount
MUCH, SILENT, ENDLESS = r"\b1\b", r"\b3\b", r"\b\d+\b"
MISBEHAVIOUR = {
    "a-list": ('say("dreamfleet-host []")', FORM),
    "no-json": ('say("dreamfleet-host {")', FORM),
    "too-deep": ('say("dreamfleet-host " + "[" * 10**5)', FORM),
    "another-kind": ("say('dreamfleet-host {\"moon\": 1}')", FORM),
    "a-number": ("say('dreamfleet-host {\"say\": 1}')", FORM),
    "a-strange-look": (READY + READY + "time.sleep(1000)", "'look'"),
    "an-endless-line": ("while True: os.write(1, b'x' * 65536)", MUCH),
    "an-endless-answer": ("os.write(1, b'dreamfleet-host '); \nwhile True: os.write(1, b'x' * 65536)", MUCH),
    "an-endless-banner": ("while True: say('welcome')", MUCH),
    "endless-progress": ("while True: say('dreamfleet-host {\"say\": \"on it\"}')", ENDLESS),
    "slow-progress": ("while True: say('dreamfleet-host {\"say\": \"on it\"}'); time.sleep(1)", ENDLESS),
    "lines-of-no-log": ("while True: say('dreamfleet-host {\"line\": \"hello\"}'); time.sleep(1)", FORM),
    "lines-amid-a-look": (READY + "\nwhile True: say('dreamfleet-host {\"line\": \"hello\"}'); time.sleep(1)", FORM),
    "endless-errors": ("while True: os.write(2, b'x' * 65536)", SILENT),
    "silence": ("time.sleep(1000)", SILENT),
    "a-refusal": ("say('no account 47'); sys.exit(1)", "47"),
    "a-huge-age": (READY + "\nsay('dreamfleet-host ' + json.dumps({'ok': LOOK}))", "age"),
    "what-it-never-reads": (READY + "time.sleep(1000)", SILENT),
}  # fmt: skip


@pytest.fixture
def fake_ssh(tmp_path):
    """A program in the place of ssh, that behaves by the host's name."""
    path = tmp_path / "ssh"
    branches = "".join(
        f"if host == {name!r}:\n" + "".join(f"    {line}\n" for line in code.splitlines())
        for name, (code, _) in MISBEHAVIOUR.items()
    )
    path.write_text(
        f"#!{sys.executable}\nimport json, os, sys, time\n"
        "def say(text): os.write(1, text.encode() + b'\\n')\n"
        f"host, LOOK = sys.argv[-2], {LOOK!r}\n{branches}{GOOD}"
    )
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return shlex.quote(str(path))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pipes of connections that ended
def test_each_fails_alone_in_little_memory(fake_ssh, tmp_path, monkeypatch):
    monkeypatch.setattr(connection, "QUICK", 3.0)
    monkeypatch.setattr("dreamfleet.coordinator.addons.spawn.remote_host.QUICK", 3.0)
    spawn = SpawnConfig(ssh=fake_ssh, remote_dir=str(tmp_path / "there"), remote_python=sys.executable)
    names = [*MISBEHAVIOUR, "good"]
    hosts = [Host(f"h{number}", name, spawn) for number, name in enumerate(names)]
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    rows = dict(zip(names, check(hosts, FleetAddress(("tcp/10.0.0.1:7447",))), strict=True))
    assert time.monotonic() - began < DEADLINE
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KiB
    assert rows.pop("good").state == "ready"
    assert len({row.what for name, row in rows.items() if MISBEHAVIOUR[name][1] == FORM}) == 1
    for name, row in rows.items():
        assert row.state == FAILED, name
        assert re.search(MISBEHAVIOUR[name][1], row.what), (name, row.what)
        assert "\n" not in row.what


def test_a_lost_host_is_said_while_others_work(monkeypatch):
    said = Event()
    monkeypatch.setattr(parallel, "log", Mock(warning=lambda *_, **__: said.set()))
    lost, other = (Mock(host=SimpleNamespace(name=name)) for name in "ab")
    lost.follow.side_effect = ConnectionFailedError("gone")
    other.follow = lambda: HostStatus("b", "ended" if said.wait(DEADLINE) else "deaf", "")
    rows = parallel._run_in_threads([lost, other], parallel._follow_until_ended, lambda: False, Mock())
    assert [(row.host, row.state) for row in rows] == [("a", FAILED), ("b", "ended")]


KINDS = [
    "ssh: Could not resolve hostname x: Name or service not known",
    "ssh: connect to host x port 22: Connection refused",
    "ssh: connect to host x port 22: Connection timed out",
    "@ WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED! @\nHost key verification failed.",
    "No ED25519 host key is known for x.\nHost key verification failed.",
    "me@x: Permission denied (publickey).",
    "Error: remote port forwarding failed for listen port 0",
]


def explained(said):
    return explain(said.splitlines(), 255, "me@x")


def test_each_kind_of_error_of_ssh_is_explained_in_a_line_of_its_own():
    found = {explained(each) for each in KINDS}
    assert len(found) == len(KINDS)
    assert not any("\n" in each for each in found)


@pytest.mark.parametrize(
    ("said", "named"),
    [
        (f"{NO_PYTHON} Python 3.9.2", "3.9.2"),
        (f"{NO_PYTHON} sh: 1: python3: not found", "--remote-python"),
        ("Warning: Permanently added 'x' to the list of known hosts.\nsomething new\n", "(something new)"),
        ("", "255"),
    ],
)
def test_what_the_host_said_is_named(said, named):
    assert named in explained(said)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pipes of a connection that ended
def test_the_ports_of_tunnels_are_read_also_to_an_ipv6_address_which_ssh_names_without_brackets():
    forwards = ("[::1]:7447", "localhost:1")
    said = (f"Allocated port {port} for remote forward to {to}" for port, to in ((5, "::1:7447"), (6, "localhost:1")))
    ssh = ("/bin/sh", "-c", "".join(f"echo {each} >&2; " for each in said) + "exec cat > /dev/null")
    connection = Connection(ssh, "a", forwards=forwards)
    try:
        assert connection.ports(forwards) == [5, 6]
    finally:
        connection.close()
        connection._listener.join(DEADLINE)  # else it holds the pipes until some later test
