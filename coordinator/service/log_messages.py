"""What a coordinator's log says of a run beside what happens: how it is, and how a worker joins. Pure."""

from __future__ import annotations

import shlex
import socket
from typing import Any

from dreamfleet.common.monitoring.eta import estimate_eta
from dreamfleet.common.monitoring.eta import summarise_status as told
from dreamfleet.common.monitoring.status import Status
from dreamfleet.common.protocol.tasks import is_unregistered
from dreamfleet.common.transport.network import Network

WILDCARD_HOSTS = ("0.0.0.0", "[::]")  # noqa: S104 - hosts that an address may name, none that is listened on


def summary(status: Status) -> tuple[str, dict[str, Any]]:
    """One line about the run as it is, and the same as facts."""
    best = status.confirmed or status.best
    facts = {
        "event": "summary", "state": status.state, "generation": status.generation.number,
        "steps_per_second": status.throughput.steps_per_second, "best": None if best is None else best.mean,
        "best_error": None if best is None else best.error, "workers": status.workers.present, "slots": status.slots,
        "eta_seconds": estimate_eta(status).seconds,
    }  # fmt: skip
    return told(status), facts


def worker_command(network: Network, run: str, task: str) -> str:
    """The command that starts a worker of the run, on this host or another; `task` is named if nothing registers it.

    A worker's join file says itself where the fleet is.
    """
    addresses = [_public_endpoint(each) for each in network.listen or network.connect]
    where = ("--connect", *addresses) if network.credentials is None else ("--join", "FILE")
    own = ("--task", task) if is_unregistered(task) else ()
    return shlex.join(("dreamfleet", "worker", "--run", run, *where, *own))


def _public_endpoint(endpoint: str) -> str:
    """An endpoint as others name it: who listens everywhere is reached by this host's name."""
    protocol, _, where = endpoint.partition("/")
    host, _, port = where.rpartition(":")
    return f"{protocol}/{socket.gethostname()}:{port}" if host in WILDCARD_HOSTS else endpoint
