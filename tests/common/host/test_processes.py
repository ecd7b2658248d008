"""Child processes, what they report, and their streams. Tests child.py, parent_death.py, reports.py and
standard_streams.py."""

import json
import os
import queue
import re
import signal
import subprocess
import sys
import threading

import pytest

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host import reports
from dreamfleet.common.host.child import CommandChild, FunctionChild
from dreamfleet.common.host.processes import VerbProcess
from dreamfleet.common.host.reports import ADDRESS
from dreamfleet.common.host.standard_streams import MAX_WAITING_CHARS, NonblockingStream
from tests.support import tasks
from tests.support.processes import DEADLINE, ends, environment, started

CHATTER = ("sh", "-c", 'yes out | head -c 300000; yes err | head -c 300000 >&2; exec "$@"', "sh")


def test_a_child_with_much_output_does_not_block_and_imports_no_modules_of_the_current_folder(tmp_path, monkeypatch):
    for name in ("dreamfleet.py", "argparse.py", "zenoh.py"):
        (tmp_path / name).write_text("raise SystemExit('hostile')\n")
    monkeypatch.chdir(tmp_path)
    with VerbProcess("--version", inside=CHATTER) as child:
        code, out = child.finish(DEADLINE)
    assert code == 0
    assert "dreamfleet 0." in out
    assert "err\n" in child.lines


def test_a_child_gets_sigterm_before_sigkill(processes, random_bundle):
    words = ("coordinator", "--run", "asked", "--runs-dir", processes.runs, "--listen", processes.endpoint)
    with VerbProcess(*words, "--bundle", random_bundle.path, "--task", tasks.TOY) as child:
        child.wait_for_report(ADDRESS, DEADLINE)
    assert child.popen.returncode == 130
    assert " asked " in child.lines[-1]


def test_a_child_dies_with_a_killed_parent():
    program = (
        "import sys; from dreamfleet.common.host.processes import VerbProcess\n"
        "child = VerbProcess('worker', '--connect', 'tcp/127.0.0.1:1', ends_with_parent=True)\n"
        "print(child.pid, flush=True); sys.stdin.read()"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", program], stdin=pipe, stdout=pipe, text=True) as parent:
        child = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
    assert ends(child)


REPORTING = (
    "from dreamfleet.common.host.reports import VARIABLE, adopt_reports, report\nimport os\n"
    "adopt_reports()\nreport('address', ['here', 7])\nreport('failure', 'é\\n')\nprint(VARIABLE in os.environ)"
)


def test_a_failure_is_reported_whatever_the_log_looks_like(tmp_path):
    environment = {**os.environ, "DREAMFLEET_LOG_FORMAT": "json"}
    for log in (None, tmp_path / "new" / "child.log"):
        with VerbProcess("coordinator", "--resume", "absent", "--runs-dir", tmp_path, "--generations", 1, log=log,
                         environment=environment) as child:  # fmt: skip
            assert child.finish(DEADLINE)[0] == 1
        (failure,) = child.reports(reports.FAILURE)
        assert child.last_line() == failure
        assert "absent" in failure
        with pytest.raises(DreamfleetError, match=reports.ADDRESS):  # it ended: no endless wait
            child.wait_for_report(reports.ADDRESS, DEADLINE)


def test_reports_reach_a_file_and_end_with_the_process_and_a_place_that_is_not_there_costs_them_alone(tmp_path):
    path = tmp_path / "reports"
    for place in (path, "", "999", "/nowhere/at/all", "."):
        environment = {**os.environ, reports.VARIABLE: str(place)}
        done = subprocess.run([sys.executable, "-c", REPORTING], env=environment, capture_output=True, check=True)
        assert (done.stdout, done.stderr) == (b"False\n", b""), "what it starts reports nowhere"
    assert list(map(json.loads, path.read_text().splitlines())) == [{"address": ["here", 7]}, {"failure": "é\n"}]
    assert path.stat().st_mode & 0o777 == 0o600


def test_what_is_no_report_is_passed_over():
    pipe = reports.ReportPipe()
    os.write(pipe.write, b'7\n[1]\nnonsense\n\xff\n{"a": 1}\n{"a": 2, "b": null}\n{"a":')
    assert (pipe.find("a"), pipe.find("b"), pipe.find("c")) == ([1, 2], [None], [])
    os.write(pipe.write, b" 3}\n")
    os.close(pipe.write)
    assert pipe.find("a") == [1, 2, 3]


linux = pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="Linux")
DEAF = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); signal.pause()"


def echo(pipe, number):
    pipe.send((2 * number, os.getpgid(0)))
    pipe.send(pipe.recv())


@linux
def test_a_function_talks_to_its_parent_and_its_end_is_heard():
    messages = queue.SimpleQueue()
    with FunctionChild(echo, 21, on_message=messages.put) as child:
        assert messages.get(timeout=DEADLINE) == (42, child.pid), "in a session of its own"
        assert child.memory > 0
        assert child.send("again")
        assert [messages.get(timeout=DEADLINE) for _ in range(2)] == ["again", None]
        assert child.wait(DEADLINE)
        assert child.exit_code == 0


@linux
@pytest.mark.parametrize("is_own", [True, False])
def test_a_command_that_ignores_sigterm_is_killed(is_own):
    child = CommandChild([sys.executable, "-S", "-c", DEAF], is_own=is_own, stdout=-1)
    with child.popen.stdout as printed:
        printed.readline()
        child.ask_to_end()
        assert not child.wait(0.01)
        assert child.end(0.01)
    assert child.exit_code == -signal.SIGKILL


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
