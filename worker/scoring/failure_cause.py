"""What made an episode fail: an exception or the end of its process as a `Failure`. Pure."""

import errno
import signal
from contextlib import suppress

from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host.user_code import find_user_line
from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol.failures import MAX_CAUSE, Failure

MAX_TEXT = 500  # characters of an error's text
MAX_CAUSES = 10  # causes of causes that are looked at
NO_ROOM = (
    errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM,
)  # fmt: skip


def is_hosts_fault(cause: BaseException | int) -> bool:  # docs/how-to/unattended.md
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


def failure_of(error: BaseException) -> Failure:
    """The failure that an exception is: its class and the first line of its message; an expected error's text alone."""
    name = encodable(one_line(type(error).__name__[:MAX_CAUSE]))[:MAX_CAUSE] or "Exception"
    text = _text(error) if isinstance(error, DreamfleetError) else f"{name}: {_text(error)}"
    if is_hosts_fault(error):
        return Failure.of_host(encodable(text[:MAX_TEXT]))
    return Failure(encodable(text[:MAX_TEXT]), name, kind="usage" if isinstance(error, UsageError) else "other")


def describe_exit(status: int) -> str:
    """How a child ended by itself; `status` is its exit status, or the negative number of a signal."""
    if status >= 0:
        return f"exit status {status}"
    name = f"signal {-status}"
    with suppress(ValueError):
        name = signal.Signals(-status).name
    return f"killed by {name}"


def crash(reason: int | str) -> Failure:
    """The failure of the jobs that a child took with it; `reason` is its exit status, or why it was killed."""
    if isinstance(reason, int) and is_hosts_fault(reason):
        return Failure.of_host(f"{describe_exit(reason)}, as the kernel does when memory is short")
    words = reason if isinstance(reason, str) else describe_exit(reason)
    return Failure(f"slot crashed ({words})", words[:MAX_CAUSE], kind="crash")  # docs/how-to/troubleshooting.md


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
