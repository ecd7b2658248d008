"""What the ssh client says when it fails, as one line with its remedy. Pure."""

from __future__ import annotations

import re

NO_PYTHON = "dreamfleet-no-python"  # said there where no Python is new enough, with what was found behind it
_KNOWN = (
    (r"Could not resolve hostname", "no such host: look at its address, or at HostName in ~/.ssh/config"),
    (r"REMOTE HOST IDENTIFICATION HAS CHANGED|Host key for .* has changed",
     "its host key is not the one that is known: if it was set up anew, remove the old one with `ssh-keygen -R HOST`, "
     "and connect once by hand; else somebody stands between"),
    (r"Host key verification failed|host key is known",
     "its host key is not known here: connect once by hand, compare what is shown, and accept it"),
    (r"Permission denied \(", "it refuses this user and key: try `ssh {address}` by hand; no password is asked for "
     "here, so load the key into ssh-agent, or name it with --ssh \"ssh -i KEY\""),
    (r"Connection refused", "nothing answers ssh at this address: start sshd there, or give its port: "
     "ssh://HOST:PORT"),
    (r"timed out|No route to host|Network is unreachable|Host is down",
     "it cannot be reached: is it on, and is its network reachable from here?"),
    (r"remote port forwarding failed|administratively prohibited",
     "its sshd allows no tunnel: set AllowTcpForwarding there, or let the coordinator --listen where hosts reach it"),
    (r"Bad configuration option|Bad owner or permissions|terminating, \d+ bad configuration",
     "the ssh client refuses its configuration"),
)  # fmt: skip
_NOISE = re.compile(r"Warning: Permanently added|^Allocated port|^\s*$|^@+$")


def explain(said: list[str], code: int | None, address: str) -> str:
    """Why a connection ended, from what the client and the other side said and its exit code."""
    text = "\n".join(said)
    if found := re.search(rf"{NO_PYTHON} (Python [\w.+]+)?", text):
        there = f" (there is {found[1]})" if found[1] else ""
        return f"no Python of 3.11 or newer there{there}: install one, or name it with --remote-python"
    for pattern, remedy in _KNOWN:
        if re.search(pattern, text):
            return remedy.format(address=address)
    last = next((each.strip() for each in reversed(said) if not _NOISE.search(each)), "")
    return f"the ssh connection ended{f' ({last})' if last else f', exit code {code}'}: try `ssh {address}` by hand"
