"""The cause with which an error's text begins, and who is at fault."""

import errno
import signal

import numpy as np
import pytest

from dreamfleet.worker.scoring.failure_cause import (
    MAX_TEXT,
    describe_crash,
    describe_exception,
    describe_exit,
    is_hosts_fault,
)


def raised_from(cause):
    try:
        raise ValueError("the world cannot be made") from cause
    except ValueError as error:
        return error


def unbounded():
    return np.zeros(2**56)


@pytest.mark.parametrize(
    "cause",
    [
        MemoryError(),
        OSError(errno.ENOSPC, "full"),
        OSError(errno.EROFS, "read-only"),
        OSError(errno.EMFILE, "too many files"),
        BlockingIOError(errno.EAGAIN, "no process left"),
        RuntimeError("can't start new thread"),
        raised_from(OSError(errno.ENOMEM, "no memory")),
        -signal.SIGKILL,
    ],
)
def test_the_host_is_at_fault(cause):
    assert is_hosts_fault(cause)
    text = describe_exit(cause) if isinstance(cause, int) else describe_exception(cause)
    assert text.startswith("host: ")


@pytest.mark.parametrize(
    "cause",
    [
        ValueError("x"),
        FileNotFoundError(errno.ENOENT, "no file"),
        RuntimeError("the road has ended"),
        raised_from(None),
        SystemExit(1),
        0,
        3,
        -signal.SIGSEGV,
        -signal.SIGTERM,
    ],
)
def test_the_candidate_is_at_fault(cause):
    assert not is_hosts_fault(cause)


def test_numpys_lack_of_memory_is_the_hosts_fault():
    with pytest.raises(MemoryError) as caught:
        unbounded()
    assert describe_exception(caught.value).startswith("host: MemoryError: Unable to allocate")


@pytest.mark.parametrize(
    ("status", "text"),
    [
        (3, "slot crashed (exit status 3)"),
        (-signal.SIGSEGV, "slot crashed (killed by SIGSEGV)"),
        (-63, "slot crashed (killed by signal 63)"),
        (-signal.SIGKILL, "host: killed by SIGKILL, as the kernel does when memory is short"),
    ],
)
def test_the_end_of_a_child(status, text):
    assert describe_crash(describe_exit(status)) == text


def test_a_class_with_an_odd_name_keeps_the_first_colon_for_the_cause():
    odd = type("a:b\nc", (Exception,), {})
    assert describe_exception(odd("1: 2")) == "a b c: 1: 2"


def test_the_text_is_one_short_line_that_can_be_sent():
    text = describe_exception(ValueError("\udc80\0" + "x" * 10_000_000 + "\nsecond"))
    assert text.startswith(r"ValueError: \udc80\x00xxx")
    assert len(text) == MAX_TEXT
    assert text.encode()
