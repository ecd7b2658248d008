"""Hosts behind a real sshd, each with its own port, host key and home folder."""

import getpass
import json
import os
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

from dreamfleet.coordinator.addons.spawn.agent import process_start
from tests.support.processes import DEADLINE, ROOT, free_port
from tests.support.programs import find_program, require_programs

LISTENS = "Server listening"


class SshHost:
    """One sshd; `home` is the home folder of its users."""

    def __init__(self, folder, name, address="127.0.0.1", inside=(), path=None, modules=ROOT, **options):
        self.name, self.address, self.inside = name, address, inside
        self.port = free_port()
        self.folder = folder / name
        self.home = self.folder / "home"
        self.home.mkdir(parents=True)
        self._key = new_key(self.folder / "host_key")
        self._config = self.folder / "sshd_config"
        shell = {"HOME": self.home, "PATH": path or f"{Path(sys.executable).parent}:{os.environ['PATH']}",
                 "PYTHONPATH": modules}  # fmt: skip
        said = {
            "ListenAddress": address, "Port": self.port, "HostKey": self._key, "PidFile": "none", "UsePAM": "no",
            "StrictModes": "no", "PasswordAuthentication": "no", "MaxStartups": "100",
            "AuthorizedKeysFile": folder / "user_key.pub", **options,
            "SetEnv": " ".join(f'"{variable}={value}"' for variable, value in shell.items()),
        }  # fmt: skip
        self._config.write_text("".join(f"{word} {value}\n" for word, value in said.items()))
        self.known = f"[{address}]:{self.port} {self._key.with_suffix('.pub').read_text()}"
        self._popen = None

    def start(self):
        Path("/run/sshd").mkdir(parents=True, exist_ok=True)  # required by sshd when it runs as root
        command = [*self.inside, find_program("sshd"), "-D", "-e", "-f", self._config]
        self._popen = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        listens = threading.Event()
        self._reader = threading.Thread(target=self._read, args=(listens,), daemon=True)
        self._reader.start()
        assert listens.wait(DEADLINE), "sshd does not start"
        return self

    def stop(self):
        """Stop sshd and all workers."""
        for path in self.root().glob("workers/*/worker.json"):
            state = json.loads(path.read_text())
            if state and process_start(state["pid"]) == state["birth"]:
                os.killpg(state["pid"], signal.SIGKILL)
        if self._popen is not None:
            self._popen.terminate()
            self._popen.wait()
            self._reader.join()
            self._popen = None

    def root(self):
        """The remote folder of environments and workers."""
        return self.home / ".local" / "share" / "dreamfleet"

    def _read(self, listens):
        with self._popen.stderr as said:
            for line in said:
                if LISTENS in line:
                    listens.set()


class SshHosts:
    """Hosts, and an ssh configuration with their names."""

    def __init__(self, folder):
        self.folder = folder
        folder.mkdir()
        self._key = new_key(folder / "user_key")
        self._hosts = {}
        self.known = folder / "known_hosts"
        self.config = folder / "ssh_config"
        self.ssh = f"ssh -F {self.config}"

    def add(self, name, **options):
        """Start a host whose key the client knows."""
        self._hosts[name] = SshHost(self.folder, name, **options).start()
        self.write()
        return self._hosts[name]

    def write(self, **strange):
        """Write the client's configuration; `strange` has addresses of foreign hosts by name."""
        self.known.write_text("".join(each.known for each in self._hosts.values()))
        addresses = {name: (host.address, host.port) for name, host in self._hosts.items()} | strange
        common = f"""Host *
  User {getpass.getuser()}
  IdentityFile {self._key}
  IdentitiesOnly yes
  IdentityAgent none
  StrictHostKeyChecking yes
  UserKnownHostsFile {self.known}
  GlobalKnownHostsFile /dev/null
"""
        hosts = [f"Host {name}\n  HostName {host}\n  Port {port}\n" for name, (host, port) in addresses.items()]
        self.config.write_text("".join([*hosts, common]))

    def config_with(self, key):
        """The same configuration with another user key."""
        path = self.folder / f"ssh_config_{key.name}"
        path.write_text(self.config.read_text().replace(f"IdentityFile {self._key}", f"IdentityFile {key}"))
        return path

    def stop(self):
        for host in self._hosts.values():
            host.stop()


@contextmanager
def ssh_hosts(folder):
    """Hosts to add; the test is skipped without sshd and ssh."""
    require_programs("sshd", "ssh")
    hosts = SshHosts(folder / "ssh")
    try:
        yield hosts
    finally:
        hosts.stop()


def new_key(path):
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", path], check=True)
    return path
