import os
import re
import subprocess
import sys
import threading

import pytest

from dreamfleet.common.host.standard_streams import MAX_WAITING_CHARS, NonblockingStream
from tests.support.processes import DEADLINE, environment, started


@pytest.fixture
def pipe():
    """The reading end of a pipe, and a stream that writes to it."""
    read, write = os.pipe()
    with os.fdopen(write, "w") as stream, os.fdopen(read, "rb") as reader:
        yield reader, stream


def read_in_background(reader, until):
    got = bytearray()

    def run():
        while not re.search(until, got):
            got.extend(os.read(reader.fileno(), 65536))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return got, thread


def test_a_slow_reader_blocks_nothing_and_drops_are_reported(pipe):
    reader, stream = pipe
    unblocked = NonblockingStream(stream)
    print("and a half", end="", file=unblocked, flush=True)
    line = "x" * 999 + "\n"
    count = 3 * MAX_WAITING_CHARS // len(line)
    for _ in range(count):
        unblocked.write(line)
    unblocked.finish(0.1)
    got, thread = read_in_background(reader, rb"[^x\n]\n")  # the end of the line that counts them
    thread.join(DEADLINE)
    assert got.startswith(b"and a half")
    arrived = got.count(line.encode())
    dropped = int(re.search(rb"\b\d+\b", got)[0])
    assert arrived + dropped == count
    assert dropped > count // 3


def test_a_closed_reader_is_no_error(pipe):
    reader, stream = pipe
    unblocked = NonblockingStream(stream)
    reader.close()
    unblocked.write("to nobody\n")
    unblocked.finish(10 * DEADLINE)  # it ends before the test's own limit


def test_a_process_exits_although_nobody_reads_its_output():
    program = (
        "import os, sys, logging\n"
        "from dreamfleet.common.host.standard_streams import make_stderr_nonblocking\n"
        "os.set_blocking(2, False)\n"
        "try:\n"
        "    while True: os.write(2, bytes(4096))\n"
        "except BlockingIOError: os.set_blocking(2, True)\n"
        "logging.basicConfig()\n"
        "make_stderr_nonblocking()\n"
        "for n in range(1000): logging.warning('nobody reads this')\n"
        "raise SystemExit(7)\n"
    )
    command = [sys.executable, "-c", program]
    with started(command, stderr=subprocess.PIPE, env=environment("/nowhere")) as popen:
        assert popen.wait(DEADLINE) == 7
