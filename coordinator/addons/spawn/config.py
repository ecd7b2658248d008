"""The hosts, and the settings with which a worker is started on each."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from posixpath import normpath
from typing import Any

from dreamfleet.common.cli.config import load, option, read_table
from dreamfleet.common.cli.key_values import split_flags
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.keys import check_worker_name
from dreamfleet.common.transport.network import is_loopback

HOSTS = "host"  # [[host]] in a file
RESERVED_FLAGS = ("--name", "--slots", "--connect", "--join")  # set by spawn itself
MOST_SLOTS = 1024
_ADDRESS = re.compile(r"(ssh://)?([^@\s]+@)?(?P<host>\[[0-9A-Fa-f:.%\w]+\]|[^@:\s/]+)(:\d+)?/?")


@dataclass(frozen=True)
class SpawnConfig:
    """How a worker is started on a host; a `[[host]]` table overrides these settings."""

    slots: int = option(0, "scoring processes of each worker; 0: one a core")
    worker_flags: str = option("", 'further flags of each `worker`, as one text: "--run night --exit-when-done"')
    env: tuple[str, ...] = option((), "variables of its environment, each as NAME=VALUE")
    remote_dir: str = option("~/.local/share/dreamfleet", "folder there that everything lies in")
    remote_python: str = option(
        "", "Python there: used as it is where dreamfleet is installed in it; else, as by default the first one of "
        "3.11 or newer on PATH, it makes an environment",
    )  # fmt: skip
    wheelhouse: Path | None = option(None, "folder of wheels here, copied there instead of a package index's")  # noqa: RUF009
    tunnel: bool | None = option(
        None, "reach --connect from here, through the ssh connection, as long as this command runs (default: where "
        "--connect is this host's own loopback)",
    )  # fmt: skip
    ssh: str = option("ssh", 'the ssh client with flags of your own: "ssh -F FILE", "ssh -J jump -i KEY"')

    def __post_init__(self) -> None:
        if not 0 <= self.slots <= MOST_SLOTS:
            raise UsageError(f"--slots must be from 0 to {MOST_SLOTS}, not {self.slots}")
        for each in self.env:
            if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*=[^\0]*", each):
                raise UsageError(f"--env {each!r}: write it as NAME=VALUE")
        if self.wheelhouse is not None and not any(self.wheelhouse.glob("*.whl")):
            raise UsageError(f"--wheelhouse {self.wheelhouse} holds no wheel: fill it with `pip download -d FOLDER`")
        if normpath(self.remote_dir.strip()) in ("/", "//", "~", ".", "..") or "\0" in self.remote_dir:
            raise UsageError(f"--remote-dir {self.remote_dir!r}: name a folder of its own")
        if not split_flags("--ssh", self.ssh):
            raise UsageError("--ssh: name the ssh client")
        split_flags("--worker-flags", self.worker_flags, "spawn", RESERVED_FLAGS)


@dataclass(frozen=True)
class Host:
    """A host, and how a worker is started there."""

    name: str = field(metadata={"help": "of host and worker (default the address without user)"})
    address: str = field(metadata={"help": "as ssh takes it: user@host, a name of ~/.ssh/config, or ssh://host:port"})
    spawn: SpawnConfig

    def __post_init__(self) -> None:
        if self.address.startswith("-") or not _ADDRESS.fullmatch(self.address):
            raise UsageError(f"{self.address!r} is not a host: write it as user@host, host, or ssh://user@host:port")
        check_worker_name(self.name)

    def forwards(self, connect: Iterable[str], *, joins: bool) -> tuple[str, ...]:
        """HOST:PORT of each endpoint to reach through a tunnel; empty without one.

        By default there is a tunnel if all endpoints are loopback addresses. With `joins` there is none by default,
        since a join file names the endpoints.
        """
        endpoints = tuple(connect)
        is_default = not joins and all(map(is_loopback, endpoints))
        if not (is_default if self.spawn.tunnel is None else self.spawn.tunnel):
            return ()
        if joins:
            raise UsageError("--tunnel carries tcp alone, which ssh encrypts, and a join file needs tls: omit one")
        if strange := [each for each in endpoints if not each.startswith("tcp/")]:
            raise UsageError(f"--tunnel carries tcp alone, which ssh encrypts, and not {', '.join(strange)}")
        return tuple(each.removeprefix("tcp/") for each in endpoints)


def read_hosts(rows: Sequence[Mapping[str, Any]], sources: Mapping[str, Any]) -> list[Host]:
    """The hosts of [[host]] tables, which override [spawn]; environment variables and flags override them."""
    hosts = []
    for number, row in enumerate(rows, start=1):
        where = f"[[{HOSTS}]] number {number}"
        own = {key: row[key] for key in ("address", "name") if key in row}
        if "address" not in own:
            raise UsageError(f'{where} has no address: write address = "user@host"')
        about = read_table(Host, where, own)
        rest = {key: value for key, value in row.items() if key not in own}
        read_table(SpawnConfig, where, rest)  # its errors name this table
        table = {**(sources.get("file") or {}).get("spawn", {}), **rest}
        spawn = load(SpawnConfig, "spawn", **{**sources, "file": {"spawn": table}})
        hosts.append(Host(about.get("name") or default_name(about["address"]), about["address"], spawn))
    return check_unique(hosts)


def check_unique(hosts: list[Host]) -> list[Host]:
    """The same hosts; `UsageError` if there are none or a name is used twice."""
    if not hosts:
        raise UsageError(f"no host is named: give user@host, or a file with [[{HOSTS}]] tables")
    names = [each.name for each in hosts]
    if twice := sorted({each for each in names if names.count(each) > 1}):
        raise UsageError(f"several hosts are called {', '.join(twice)}: give each its own name in a file, for --hosts")
    return hosts


def default_name(address: str) -> str:
    """The name of a host without a given one, from its address."""
    found = _ADDRESS.fullmatch(address)
    return re.sub(r"[^A-Za-z0-9.-]+", "-", found["host"] if found else address).strip("-.")[:63] or "worker"
