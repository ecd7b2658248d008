"""Several hosts on this machine: network namespaces, each on a cable of its own."""

import json
import os
import random
import secrets
import subprocess
from contextlib import contextmanager
from ipaddress import ip_interface, ip_network

import pytest

from tests.support.programs import find_program, require_programs

CABLES = list(ip_network("198.18.0.0/16").subnets(new_prefix=30))  # RFC 2544: reserved for network tests


class Host:
    """A namespace; `address` is our end of its cable, `own` is its end."""

    def __init__(self, name, cable):
        self.name = name
        self.address, self.own = map(str, cable.hosts())
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
        """Drop all packets from now on, without an error to either side."""
        _ip("link", "set", self._near, "down")

    def plug(self):
        _ip("link", "set", self._near, "up")

    def remove(self):
        _ip("netns", "del", self.name)  # which removes both ends of the cable


@contextmanager
def new_host():
    """A host, or `None` if this process may not make one."""
    name = f"df{secrets.token_hex(4)}"
    if find_program("ip") is None:
        yield None
        return
    try:
        host = Host(name, _free_cable())
    except subprocess.CalledProcessError:
        subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)
        yield None
        return
    try:
        yield host
    finally:
        host.remove()


def require_hosts(*hosts):
    """Skip the test unless all hosts could be made."""
    if None in hosts:
        if os.geteuid() == 0:
            require_programs("ip")
        pytest.skip("network namespaces need root and iproute2")


def _free_cable():
    """A subnet that no other test run uses or left behind when it was killed."""
    devices = json.loads(_ip("-json", "-4", "addr", "show"))
    taken = {ip_interface(f"{a['local']}/30").network for device in devices for a in device.get("addr_info", ())}
    return random.SystemRandom().choice([cable for cable in CABLES if cable not in taken])


def _ip(*arguments):
    return subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True).stdout
