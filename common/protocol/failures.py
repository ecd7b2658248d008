"""What a worker's error says: its cause, and whether the host is at fault rather than the job."""

from __future__ import annotations

HOST_PREFIX = "host: "


def failure_cause(error: str) -> str:
    """The part of an error that is equal for equal failures: the text before the first colon.

    >>> failure_cause("ValueError: array at 0x7f3a is not finite")
    'ValueError'
    """
    return error.partition(":")[0]


def is_host_failure(error: str) -> bool:
    """Whether a shortage of the host (memory, disk, processes) ended the attempt.

    >>> is_host_failure("host: killed by SIGKILL")
    True
    """
    return error.startswith(HOST_PREFIX)
