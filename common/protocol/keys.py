"""Zenoh keys of protocol version 2, and the names that they may contain. Pages: upgrade.md."""

import re
import secrets
import socket
from collections.abc import Callable

from dreamfleet.common.errors import UsageError

PROTOCOL_VERSION = 2
ROOT = "dreamfleet"
_PREFIX = f"{ROOT}/v{PROTOCOL_VERSION}"
RUN_PATTERN = "[A-Za-z0-9][A-Za-z0-9_-]{0,62}"
_RUN = re.compile(RUN_PATTERN)
_WORKER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
_PROCESS = re.compile(r"[0-9a-f]{8}")


def check_run_name(name: str) -> str:
    """Return `name` if it may name a run, else raise `UsageError`."""
    return _check_name(name, _RUN, "run", "'_' and '-'")


def check_worker_name(name: str) -> str:
    """Return `name` if it may name a worker, else raise `UsageError`."""
    return _check_name(name, _WORKER_NAME, "worker", "'.', '_' and '-'")


def _check_name(name: str, pattern: re.Pattern[str], what: str, marks: str) -> str:
    if not pattern.fullmatch(name):
        raise UsageError(
            f"{name!r} cannot name a {what}: use 1 to 63 of A-Z, a-z, 0-9, {marks}, and begin with a letter or a digit"
        )
    return name


def is_worker_identity(identity: str) -> bool:
    """Whether `identity` has the form `<name>/<process>`."""
    name, _, process = identity.partition("/")
    return bool(_WORKER_NAME.fullmatch(name) and _PROCESS.fullmatch(process))


def host_of(worker: str) -> str:
    """The name in a worker's identity, without its process: its later processes, on the same host, share it."""
    return worker.partition("/")[0]  # counts alike: coordinator/addons/dashboard/page/live.js


def new_worker_identity(name: str | None = None) -> str:
    """A new identity `<name>/<process>` of a worker process; `process` is 8 random hex digits.

    The default name is the host's in lower case, without characters that are invalid in keys. `UsageError` for an
    invalid `name`.
    """
    if name is not None:
        return f"{check_worker_name(name)}/{secrets.token_hex(4)}"
    clean = re.sub(r"[^a-z0-9.-]+", "-", socket.gethostname().lower()).strip("-.")[:63] or "worker"
    return f"{clean}/{secrets.token_hex(4)}"


def _of_run(kind: str) -> Callable[[str, str], str]:
    """The keys of a kind: they name a run, and end in a worker, a nonce, a verb or a hash."""
    return lambda run, end: f"{_PREFIX}/{run}/{kind}/{end}"


def _event(kind: str) -> Callable[[str], str]:
    """The key of a run's events of a kind, from the coordinator to everyone."""
    return lambda run: f"{_PREFIX}/{run}/event/{kind}"


# From one worker, and to it
job = _of_run("job")  # from the coordinator: numbered batches
result = _of_run("result")  # to the coordinator: finished jobs
heartbeat = _of_run("beat")  # to the coordinator: its jobs and load
upload = _of_run("upload")  # to the coordinator: a job's output that is too large for a result
view = _of_run("view")  # to everyone: live frames, while somebody subscribes
live_worker = _of_run("live/worker")  # its liveliness token

# By nonces, which distinguish two coordinators of one run
live_coordinator = _of_run("live/coordinator")  # its liveliness token
claim = _of_run("claim")  # query from another coordinator: who are you

# Queries of anyone
control = _of_run("control")  # by verbs: `pause`, `resume`, `drain` or `stop`
batch = _of_run("batch")  # by verbs: `submit`, `read` and `cancel` with an id in the parameters, or `list`
bundle = _of_run("bundle")  # by SHA-256: a part of the world model; parameters `offset` and `length`, in bytes

event_generation = _event("generation")  # each closed generation
event_status = _event("status")  # as the coordinator leaves: the last status
event_batch = _event("batch")  # each change of a submitted batch


def hello(run: str) -> str:
    """Worker to coordinator: query to join a run, or every live run with `*`. Outside the version; never changes."""
    return f"{ROOT}/hello/{run}"


def secured_hello(run: str, worker: str) -> str:
    """Worker to coordinator: query to join a secured run; the router checks the worker's name in the key."""
    return f"{ROOT}/hello/{run}/{worker}"


def status(run: str, part: str = "") -> str:
    """Query for a run's status, as JSON; `part` is one of `dreamfleet.common.client.status.PARTS`."""
    return f"{_PREFIX}/{run}/status/{part}" if part else f"{_PREFIX}/{run}/status"


def all_workers(kind: str, run: str) -> str:
    """The `result`, `beat`, `upload`, `view` or `live/worker` keys of all workers of a run."""
    return f"{_PREFIX}/{run}/{kind}/*/*"


def worker_from_key(key: str) -> str:
    """The worker's identity `<name>/<process>` in a key: its last two chunks."""
    return "/".join(key.rsplit("/", 2)[-2:])
