"""Messages of the ssh client, explained in one line with a remedy."""

import pytest

from dreamfleet.coordinator.addons.spawn.connection import NO_PYTHON, explain

SAID = {
    "ssh: Could not resolve hostname x: Name or service not known": "no such host",
    "ssh: connect to host x port 22: Connection refused": "nothing answers ssh",
    "ssh: connect to host x port 22: Connection timed out": "cannot be reached",
    "ssh: connect to host x port 22: No route to host": "cannot be reached",
    "@ WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED! @\nHost key verification failed.": "not the one that is known",
    "No ED25519 host key is known for x.\nHost key verification failed.": "is not known here",
    "me@x: Permission denied (publickey).": "refuses this user and key: try `ssh me@x` by hand",
    "Error: remote port forwarding failed for listen port 0": "allows no tunnel",
    f"{NO_PYTHON} Python 3.9.2": "no Python of 3.11 or newer there (there is Python 3.9.2)",
    f"{NO_PYTHON} sh: 1: python3: not found": "no Python of 3.11 or newer there:",
    "Warning: Permanently added 'x' to the list of known hosts.\nsomething new\n": "ended (something new)",
    "": "exit code 255",
}


@pytest.mark.parametrize("said", SAID)
def test_an_error_of_ssh_is_explained_with_a_remedy(said):
    assert SAID[said] in explain(said.splitlines(), 255, "me@x")
