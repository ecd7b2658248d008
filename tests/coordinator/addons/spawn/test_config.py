"""The hosts of a file, their settings, and whether each needs a tunnel."""

import argparse
import re
from pathlib import Path

import pytest

from dreamfleet.common.cli.global_config import read_config_file
from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.addons.spawn.config import Host, SpawnConfig, default_name, read_hosts
from tests.support.processes import ROOT

LOOPBACK, WIDE = "tcp/127.0.0.1:7447", "tcp/10.0.0.1:7447"


def hosts(*rows, file=None, flags=None, environment=None):
    sources = {"file": file or {}, "flags": argparse.Namespace(**(flags or {})), "environment": environment or {}}
    return read_hosts(rows, sources)


def test_a_hosts_table_overrides_the_file_and_flags_override_it(tmp_path):
    (tmp_path / "a.whl").touch()
    row = {"address": "me@big", "slots": 16, "env": ["A=1", "B=x=y"], "wheelhouse": str(tmp_path)}
    (host,) = hosts(row, file={"spawn": {"slots": 4, "remote_dir": "/data/fleet"}})
    assert (host.name, host.spawn.slots, host.spawn.remote_dir) == ("big", 16, "/data/fleet")
    assert host.spawn.env == ("A=1", "B=x=y")
    assert host.spawn.wheelhouse == tmp_path
    (host,) = hosts(row, environment={"DREAMFLEET_SPAWN_SLOTS": "3"})
    assert host.spawn.slots == 3
    (host,) = hosts(row, flags={"slots": 2}, environment={"DREAMFLEET_SPAWN_SLOTS": "3"})
    assert host.spawn.slots == 2


def test_the_documented_file_is_valid(tmp_path):
    (tmp_path / "a.whl").touch()
    text = re.search(r"```toml\n(.*?)```", (Path(ROOT) / "docs" / "how-to" / "hosts.md").read_text(), re.DOTALL)[1]
    path = tmp_path / "hosts.toml"
    path.write_text(text.replace("/data/wheels", str(tmp_path)))
    file = read_config_file(path)
    big, node = hosts(*file["host"], file=file)
    assert (big.name, big.spawn.slots, big.spawn.worker_flags) == ("big", 16, "--run night --exit-when-done")
    assert (node.name, node.spawn.wheelhouse, node.spawn.env) == ("node-7", tmp_path, ("OMP_NUM_THREADS=1",))


@pytest.mark.parametrize(
    ("row", "why"),
    [
        ({}, "host"),
        ({"address": "a", "slot": 3}, "'slots'"),
        ({"address": "a", "slots": "3"}, "slots .*1"),
        ({"address": "a", "slots": -1}, "--slots"),
        ({"address": "-oProxyCommand=x"}, "-oProxyCommand=x"),
        ({"address": "a b"}, "a b"),
        ({"address": "a", "name": "x/y"}, "x/y"),
        ({"address": "a", "env": ["A"]}, "--env"),
        ({"address": "a", "worker_flags": "--slots 3"}, "--worker-flags"),
        ({"address": "a", "worker_flags": "'"}, "No closing quotation"),
        *(({"address": "a", "remote_dir": folder}, "--remote-dir") for folder in ("", "/", "~/", "./", "~/.", "a\0b")),
        ({"address": "a", "wheelhouse": "/nowhere"}, "--wheelhouse"),
    ],
)
def test_a_bad_file_is_refused_with_the_reason(row, why):
    with pytest.raises(UsageError, match=why):
        hosts(row)


def test_host_names_are_unique():
    assert [each.name for each in hosts({"address": "a@h"}, {"address": "b@h", "name": "other"})] == ["h", "other"]
    with pytest.raises(UsageError, match=r"\bh\b"):
        hosts({"address": "a@h"}, {"address": "b@h"})
    with pytest.raises(UsageError):
        hosts()


@pytest.mark.parametrize(
    ("address", "name"),
    [("me@big.example", "big.example"), ("ssh://me@big:2222", "big"), ("[fe80::1]", "fe80-1"), ("node_1", "node-1")],
)
def test_a_host_is_called_by_its_address(address, name):
    assert Host(default_name(address), address, SpawnConfig()).name == name


def test_a_tunnel_is_the_default_to_a_loopback_alone():
    def forwards(tunnel, *connect, joins=False):
        return Host("a", "a", SpawnConfig(tunnel=tunnel)).forwards(connect, joins=joins)

    assert forwards(None, LOOPBACK) == ("127.0.0.1:7447",)
    assert forwards(None, "tcp/[::1]:7447", "tcp/localhost:1") == ("[::1]:7447", "localhost:1")
    assert forwards(None, WIDE) == forwards(None, LOOPBACK, WIDE) == forwards(False, LOOPBACK) == ()
    assert forwards(None, LOOPBACK, joins=True) == ()
    assert forwards(True, WIDE) == ("10.0.0.1:7447",)
    for connect, joins in ((("tls/10.0.0.1:7447",), False), ((), True)):
        with pytest.raises(UsageError, match="--tunnel"):
            forwards(True, *connect, joins=joins)
