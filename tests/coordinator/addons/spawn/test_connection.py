"""Messages of the ssh client: errors are explained in one line with a remedy, and ports of tunnels are read."""

import pytest

from dreamfleet.coordinator.addons.spawn.connection import NO_PYTHON, Connection, explain
from tests.support.processes import DEADLINE

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
