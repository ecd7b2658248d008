"""The cause of a failure, as an error's text begins: the same on every host and in every run. Pure.

The coordinator compares the text before the first colon, so this part holds no number, path or address.
"""

from __future__ import annotations

import errno
import signal
from contextlib import suppress

from dreamfleet.common.host.user_code import find_user_line
from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol.failures import HOST_PREFIX, is_host_failure

MAX_TEXT = 500  # characters of an error's text
MAX_CAUSES = 10  # causes of causes that are looked at
CRASH = "slot crashed"
NO_ROOM = (
    errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM,
)  # fmt: skip


def is_hosts_fault(cause: BaseException | int) -> bool:
    """Whether the host is at fault and not the candidate; `cause` is an exception, or a child's exit status.

    R8: no memory, a disk that is full, read-only or broken, no descriptor, process or thread left, and a SIGKILL that
    the worker did not send. An exception counts too if it was raised from one of these.
    """
    if isinstance(cause, int):
        return cause == -signal.SIGKILL
    error: BaseException | None = cause
    for _ in range(MAX_CAUSES):
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            return True
        if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "start new thread" in _text(error)):
            return True
        error = None if error is None else error.__cause__
    return False


def describe_exception(error: BaseException) -> str:
    """One line: the exception's class, a colon, and the first line of its message."""
    name = one_line(type(error).__name__[:MAX_TEXT]).replace(":", " ") or "Exception"
    host = HOST_PREFIX if is_hosts_fault(error) else ""
    return encodable(f"{host}{name}: {_text(error)}"[:MAX_TEXT])


def describe_exit(status: int) -> str:
    """How a child ended by itself; `status` is its exit status, or the negative number of a signal."""
    if is_hosts_fault(status):
        return f"{HOST_PREFIX}killed by SIGKILL, as the kernel does when memory is short"
    if status >= 0:
        return f"exit status {status}"
    name = f"signal {-status}"
    with suppress(ValueError):
        name = signal.Signals(-status).name
    return f"killed by {name}"


def describe_crash(reason: str) -> str:
    """The error of the jobs that a child took with it; `reason` is of `describe_exit` or why it was killed."""
    return reason if is_host_failure(reason) else f"{CRASH} ({reason})"


def describe_loss(reason: int | str) -> str:
    """The error of the episode that a process of a pool was lost with; `reason` as `map_in_processes` gives it."""
    return describe_crash(reason if isinstance(reason, str) else describe_exit(reason))


def is_crash(error: str) -> bool:
    """Whether the child died of the episode or was killed, so that the process that drives it again would too."""
    return error.startswith(CRASH) or is_host_failure(error)


def encodable(text: str) -> str:
    """Replace half surrogate pairs, as in names of files, which UTF-8 cannot encode."""
    return text.encode(errors="replace").decode()


def _text(error: BaseException) -> str:
    """The first line of an exception's message, printable; a simulator's own exceptions may fail to give it."""
    try:
        lines = str(error)[: 10 * MAX_TEXT].strip().splitlines()
        return one_line(lines[0]) if lines else find_user_line(error)
    except BaseException as another:  # also `SystemExit`
        return f"its message cannot be read ({type(another).__name__})"
