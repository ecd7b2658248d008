"""How many files and connections this process may have open at once."""

from __future__ import annotations

import resource
from contextlib import suppress

ENOUGH = 65_536
KEPT = 64  # for ourselves: journal, world model, controller, Zenoh's own


def raise_limit() -> None:
    """As many as the host allows without asking: the usual 1024 is a habit for programs that use `select`."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = ENOUGH if hard == resource.RLIM_INFINITY else min(hard, ENOUGH)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def room_for_connections() -> int:
    """How many connections leave enough for ourselves."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return max((ENOUGH if soft == resource.RLIM_INFINITY else soft) - KEPT, 8)
