"""What made an episode fail, and who is at fault."""

import errno
import signal

import pytest

from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.protocol.failures import MAX_CAUSE
from dreamfleet.worker.scoring.failure_cause import MAX_TEXT, crash, failure_of, is_hosts_fault


def raised_from(cause):
    try:
        raise ValueError("the world cannot be made") from cause
    except ValueError as error:
        return error


HOST = [
    MemoryError(),
    *(OSError(number, "") for number in (errno.ENOSPC, errno.EROFS, errno.EMFILE)),
    BlockingIOError(errno.EAGAIN, "no process left"),
    RuntimeError("can't start new thread"),
    raised_from(OSError(errno.ENOMEM, "no memory")),
    -signal.SIGKILL,
]
OTHER = [
    ValueError("x"), FileNotFoundError(errno.ENOENT, "no file"), RuntimeError("the road has ended"), raised_from(None),
    SystemExit(1), 0, 3, -signal.SIGSEGV, -signal.SIGTERM,
]  # fmt: skip


@pytest.mark.parametrize("cause", [*HOST, *OTHER], ids=repr)
def test_who_is_at_fault_follows_from_the_error_or_the_exit_status(cause):
    is_status, is_host = isinstance(cause, int), cause in HOST
    assert is_hosts_fault(cause) == is_host
    found = crash(cause) if is_status else failure_of(cause)
    assert found.kind == ("host" if is_host else "crash" if is_status else "other")


@pytest.mark.parametrize(
    ("reason", "cause"),
    [(3, "exit status 3"), (-signal.SIGSEGV, "killed by SIGSEGV"), (-63, "killed by signal 63"), ("stuck", "stuck")],
)
def test_equal_ends_of_a_child_have_an_equal_cause(reason, cause):
    found = crash(reason)
    assert (found.cause, found.kind, found.ends_process) == (cause, "crash", True)


def test_the_cause_is_the_class_whatever_the_message_says():
    found = failure_of(ValueError("host: UsageError: slot crashed (exit status 3)"))
    assert (found.cause, found.kind, found.ends_process) == ("ValueError", "other", False)


def test_the_text_of_an_expected_error_stands_alone():
    for error, kind in ((UsageError("give --task"), "usage"), (BundleError("it is damaged"), "other")):
        found = failure_of(error)
        assert (found.text, found.cause, found.kind) == (str(error), type(error).__name__, kind)


def test_the_text_is_one_short_line_that_can_be_sent():
    failure = failure_of(ValueError("\udc80\0" + "x" * 10_000_000 + "\nsecond"))
    assert failure.text.startswith(r"ValueError: \udc80\x00xxx")
    assert len(failure.text) == MAX_TEXT
    assert failure.text.encode()
    odd = failure_of(type("a:b\n" * 1000, (Exception,), {})())
    assert 0 < len(odd.cause) <= MAX_CAUSE
    assert odd.cause.isprintable()
