"""From an empty folder, a wheel and a file of three hosts to a fleet that works, and back to nothing.

The program that is called is installed from a wheel, in an environment of its own, in a folder that holds nothing else.
"""

import json
import logging
import os
import subprocess
import sys
import time
from contextlib import ExitStack

import pytest

from dreamfleet.common.addons.access.authority import Authority
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.security.credentials import read_join_file
from dreamfleet.common.transport.session import Network
from dreamfleet.coordinator.addons.spawn.parcel import pack_wheel
from tests.support.hosts import new_host, require_hosts
from tests.support.processes import free_port, until

pytestmark = [pytest.mark.long, pytest.mark.timeout(1800)]
log = logging.getLogger(__name__)
BARE = "/usr/local/bin:/usr/bin:/bin"  # where no dreamfleet is installed
NAMES = ("x", "y", "z")
SLOTS = 2
SOON = 120  # seconds from the command to three hosts that score
PATIENCE = 600


class Newcomer:
    """Somebody with a wheel, an environment of it, and an empty folder."""

    def __init__(self, folder):
        self.folder = folder / "empty"
        self.folder.mkdir()
        self.house = folder / "house"
        packed = pack_wheel(native=True)
        wheel = folder / packed.name
        wheel.write_bytes(packed.data)
        self._pip(sys.executable, "download", "--dest", self.house, f"{wheel}[worker,access]")
        subprocess.run([sys.executable, "-m", "venv", folder / "environment"], check=True)
        self._bin = folder / "environment" / "bin"
        self._pip(self._bin / "python", "install", "--no-index", "--find-links", self.house, f"{wheel}[access]")
        clean = {"HOME": str(folder), "PATH": os.environ["PATH"], "OMP_NUM_THREADS": "1"}
        self._how = {"cwd": self.folder, "env": clean, "text": True}
        self._started = []

    def start(self, *words):
        """A verb that runs until the end."""
        with (self.folder.parent / f"{words[0]}.log").open("w") as out:
            command = [self._bin / "dreamfleet", *map(str, words)]
            self._started.append(subprocess.Popen(command, **self._how, stdout=out, stderr=out, start_new_session=True))

    def rows(self, *words, code=0):
        """The rows that a verb prints, by host."""
        done = subprocess.run([self._bin / "dreamfleet", *map(str, words), "--json"], **self._how, check=False,
                              capture_output=True, timeout=PATIENCE)  # fmt: skip
        assert done.returncode == code, done.stderr
        return {row["host"]: row for row in json.loads(done.stdout.splitlines()[-1])["hosts"]}

    def end(self):
        while self._started:
            process = self._started.pop()
            process.terminate()
            process.wait(PATIENCE)

    def _pip(self, python, *words):
        subprocess.run([python, "-m", "pip", words[0], "--quiet", *words[1:]], check=True)


@pytest.fixture(scope="module")
def newcomer(tmp_path_factory):
    return Newcomer(tmp_path_factory.mktemp("new"))


@pytest.mark.parametrize("source", ["wheelhouse", "index"])
@pytest.mark.parametrize("secured", [False, True], ids=["open", "joined"])
def test_three_hosts_score_soon_after_one_command_and_another_leaves_nothing(
    newcomer, hosts, tmp_path, source, secured
):
    """A wheelhouse serves hosts that reach nothing but us; an index, this host under three names."""
    with ExitStack() as stack:
        cables = [stack.enter_context(new_host()) for _ in NAMES] if source == "wheelhouse" else []
        require_hosts(*cables)
        near = [each.address for each in cables] or ["127.0.0.1"]
        where = [{"address": each.own, "inside": each.inside} for each in cables] or [{}] * len(NAMES)
        there = [hosts.add(name, path=BARE, modules="", **how) for name, how in zip(NAMES, where, strict=True)]
        port, access = free_port(), tmp_path / "access"
        endpoints = [f"{'tls' if secured else 'tcp'}/{each}:{port}" for each in near]
        mine = None
        if secured:
            authority = Authority.create(access)
            authority.issue("coordinator", "home", tmp_path / "home.join", hosts=near)
            authority.issue("worker", "lab", tmp_path / "lab.join", connect=endpoints)
            authority.issue("operator", "me", tmp_path / "me.join", connect=endpoints)
            mine = read_join_file(tmp_path / "me.join")
        network = Network(connect=(endpoints[0],), credentials=mine)
        reach = f'join = "{tmp_path}/lab.join"\n' if secured else f"connect = {json.dumps(endpoints)}\n"
        rows = "".join(f'[[host]]\naddress = "{name}"\n' for name in NAMES)
        file = newcomer.folder / "hosts.toml"
        house = f'wheelhouse = "{newcomer.house}"\n' if source == "wheelhouse" else ""
        file.write_text(f'{reach}[spawn]\nssh = "{hosts.ssh}"\nslots = {SLOTS}\ntunnel = false\n{house}{rows}')
        stack.callback(file.unlink)
        stack.callback(newcomer.end)
        newcomer.start("coordinator", "--run", "far", "--runs-dir", tmp_path / "runs", "--listen", *endpoints,
                       *(("--join", tmp_path / "home.join") if secured else ("--insecure",)))  # fmt: skip
        until(lambda: status(network), "the coordinator")

        began = time.monotonic()
        up = newcomer.rows("spawn", "--hosts", file)
        printed_after = time.monotonic() - began
        until(lambda: status(network).slots == len(NAMES) * SLOTS, "the whole fleet")
        until(lambda: status(network).throughput.environment_steps, "a score")
        took = time.monotonic() - began
        log.info(
            "%s, %s: up %.0f s, scoring after %.0f s", source, "joined" if secured else "open", printed_after, took
        )
        assert {row["state"] for row in up.values()} == {"started"}
        assert took < SOON
        assert {row["state"] for row in newcomer.rows("down", "--hosts", file).values()} == {"left"}
        assert [list(host.home.iterdir()) for host in there] == [[], [], []]
    assert list(newcomer.folder.iterdir()) == []


def status(network):
    try:
        with Client(network) as client:
            return client.status()
    except DreamfleetError:
        return None
