"""Several hosts on this machine: network namespaces, each on a cable of its own."""

import os
import shutil
import subprocess
from contextlib import contextmanager
from itertools import count

_numbers = count()


class Host:
    """A namespace; `address` is this end of its cable, which it reaches us by, `own` is its own end."""

    def __init__(self, name, number):
        self.name = name
        self.address, self.own = (f"198.18.{os.getpid() % 250}.{4 * number + end}" for end in (1, 2))  # RFC 2544
        self.inside = ("ip", "netns", "exec", name)
        self._near, far = f"{name}-a", f"{name}-b"
        _ip("netns", "add", name)
        _ip("link", "add", self._near, "type", "veth", "peer", "name", far, "netns", name)
        _ip("addr", "add", f"{self.address}/30", "dev", self._near)
        _ip("link", "set", self._near, "up")
        _ip("-n", name, "addr", "add", f"{self.own}/30", "dev", far)
        for device in ("lo", far):
            _ip("-n", name, "link", "set", device, "up")

    def unplug(self):
        """Whatever is sent from now on is lost, and nobody is told."""
        _ip("link", "set", self._near, "down")

    def plug(self):
        _ip("link", "set", self._near, "up")

    def remove(self):
        _ip("netns", "del", self.name)  # its end of the cable goes with it, and so does ours


@contextmanager
def new_host():
    """A host, or `None` where this process may not make one."""
    number = next(_numbers)
    name = f"df{os.getpid()}-{number}"
    if shutil.which("ip") is None:
        yield None
        return
    try:
        host = Host(name, number)
    except subprocess.CalledProcessError:
        subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)
        yield None
        return
    try:
        yield host
    finally:
        host.remove()


def _ip(*arguments):
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
