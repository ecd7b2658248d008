"""Zenoh keys of protocol version 2, and the names that they may contain."""

from __future__ import annotations

import re
import secrets
import socket

from dreamfleet.common.errors import UsageError

PROTOCOL_VERSION = 2
ROOT = "dreamfleet"
_PREFIX = f"{ROOT}/v{PROTOCOL_VERSION}"
RUN_PATTERN = "[A-Za-z0-9][A-Za-z0-9_-]{0,62}"
_RUN = re.compile(RUN_PATTERN)
_WORKER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
_LIFE = re.compile(r"[0-9a-f]{8}")


def check_run_name(name: str) -> str:
    """Return `name` if it may name a run, else raise `UsageError`."""
    if not _RUN.fullmatch(name):
        raise UsageError(
            f"{name!r} cannot name a run: use 1 to 63 of A-Z, a-z, 0-9, '_' and '-', and begin with a letter or a digit"
        )
    return name


def check_worker_name(name: str) -> str:
    """Return `name` if it may name a worker, else raise `UsageError`."""
    if not _WORKER_NAME.fullmatch(name):
        raise UsageError(
            f"{name!r} cannot name a worker: use 1 to 63 of A-Z, a-z, 0-9, '.', '_' and '-', and begin with a letter "
            "or a digit"
        )
    return name


def is_worker_identity(identity: str) -> bool:
    """Whether `identity` has the form `<name>/<life>`."""
    name, _, life = identity.partition("/")
    return bool(_WORKER_NAME.fullmatch(name) and _LIFE.fullmatch(life))


def new_worker_identity(name: str | None = None) -> str:
    """A new identity `<name>/<life>` of a worker process; the life is 8 random hex digits.

    The default name is the host's in lower case, without characters that are invalid in keys. `UsageError` for an
    invalid `name`.
    """
    if name is not None:
        return f"{check_worker_name(name)}/{secrets.token_hex(4)}"
    clean = re.sub(r"[^a-z0-9.-]+", "-", socket.gethostname().lower()).strip("-.")[:63] or "worker"
    return f"{clean}/{secrets.token_hex(4)}"


def hello(run: str) -> str:
    """Worker to coordinator: query to join a run, or every live run with `*`. Outside the version; never changes."""
    return f"{ROOT}/hello/{run}"


def secured_hello(run: str, worker: str) -> str:
    """Worker to coordinator: query to join a secured run; the router checks the worker's name in the key."""
    return f"{ROOT}/hello/{run}/{worker}"


def job(run: str, worker: str) -> str:
    """Coordinator to one worker: numbered batches."""
    return f"{_PREFIX}/{run}/job/{worker}"


def result(run: str, worker: str) -> str:
    """One worker to the coordinator: finished jobs."""
    return f"{_PREFIX}/{run}/result/{worker}"


def heartbeat(run: str, worker: str) -> str:
    """One worker to the coordinator: its jobs and load."""
    return f"{_PREFIX}/{run}/beat/{worker}"


def live_worker(run: str, worker: str) -> str:
    """A worker's liveliness token."""
    return f"{_PREFIX}/{run}/live/worker/{worker}"


def live_coordinator(run: str, nonce: str) -> str:
    """A coordinator's liveliness token; the nonce distinguishes two coordinators of one run."""
    return f"{_PREFIX}/{run}/live/coordinator/{nonce}"


def claim(run: str, nonce: str) -> str:
    """Query from one coordinator of a run to another: who are you."""
    return f"{_PREFIX}/{run}/claim/{nonce}"


def status(run: str, part: str = "") -> str:
    """Query for a run's status, as JSON; `part` is one of `dreamfleet.common.client.status.PARTS`."""
    return f"{_PREFIX}/{run}/status/{part}" if part else f"{_PREFIX}/{run}/status"


def control(run: str, verb: str) -> str:
    """Query that requests `pause`, `resume`, `drain` or `stop`."""
    return f"{_PREFIX}/{run}/control/{verb}"


def batch(run: str, verb: str) -> str:
    """Query about submitted batches: `submit`, `read` and `cancel` with an id in the parameters, or `list`."""
    return f"{_PREFIX}/{run}/batch/{verb}"


def bundle(run: str, sha256: str) -> str:
    """Query for a part of the frozen world model: parameters `offset` and `length`, in bytes."""
    return f"{_PREFIX}/{run}/bundle/{sha256}"


def upload(run: str, worker: str) -> str:
    """One worker to the coordinator: a job's output that is too large for a result."""
    return f"{_PREFIX}/{run}/upload/{worker}"


def event_generation(run: str) -> str:
    """Coordinator to everyone: each closed generation."""
    return f"{_PREFIX}/{run}/event/generation"


def event_status(run: str) -> str:
    """Coordinator to everyone, as it leaves: the last status."""
    return f"{_PREFIX}/{run}/event/status"


def event_batch(run: str) -> str:
    """Coordinator to everyone: each change of a submitted batch."""
    return f"{_PREFIX}/{run}/event/batch"


def view(run: str, worker: str) -> str:
    """One worker to everyone: live frames, while somebody subscribes."""
    return f"{_PREFIX}/{run}/view/{worker}"


def all_workers(kind: str, run: str) -> str:
    """The `result`, `beat`, `upload`, `view` or `live/worker` keys of all workers of a run."""
    return f"{_PREFIX}/{run}/{kind}/*/*"


def worker_from_key(key: str) -> str:
    """The worker's identity `<name>/<life>` in a key: its last two chunks."""
    name, life = key.rsplit("/", 2)[-2:]
    return f"{name}/{life}"
