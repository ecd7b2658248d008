"""Real coordinators and workers as child processes, with waits for their output."""

import fcntl
import io
import json
import os
import queue
import select
import signal
import socket
import subprocess
import threading
import time
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path

import psutil

from dreamfleet.common.cli import command_line
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.host.processes import POLL_INTERVAL, VerbProcess, command
from dreamfleet.common.host.reports import ADDRESS

ROOT = Path(__file__).parents[2]
DEADLINE = 300  # seconds to wait for an event: many times the usual, since a machine may be busy


def runs(pid):
    """Whether a process is there, and not only waits to be reaped."""
    with suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    return False


def free_port():
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def call_here(*words):
    """Run a verb in this process, where no process of its own is the point: exit code, stdout, stderr."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        try:
            code = command_line.main([*map(str, words)])
        except SystemExit as ended:  # such as for --help
            code = ended.code
    return code, out.getvalue(), err.getvalue()


def printed(*words, call=call_here):
    """What a verb prints that ends well in this process, or by another `call`."""
    code, out, err = call(*words)
    assert code == 0, err
    return out


def refused(datum, *words, code=2, call=call_here):
    """Assert that a verb ends with this exit code and a line with this datum."""
    found, out, err = call(*words)
    assert (found, datum in err.strip().splitlines()[-1], "Traceback" in out + err) == (code, True, False), err


def environment(cache, root=ROOT):
    inherited = {name: value for name, value in os.environ.items() if name != "SDL_VIDEODRIVER"}  # as in a user's shell
    return {
        **inherited,
        "PYTHONPATH": os.pathsep.join(filter(None, (str(root), os.environ.get("PYTHONPATH")))),
        "DREAMFLEET_CACHE": str(cache),
        "PYTHONUNBUFFERED": "1",
        "PYTHONFAULTHANDLER": "1",  # a crash in native code leaves the stacks of its threads
        "COLUMNS": "120",
    }


def until(found, what="what is waited for"):
    deadline = time.monotonic() + DEADLINE
    while not found():
        assert time.monotonic() < deadline, f"{what} did not come"
        time.sleep(0.05)


def ends(pidfd):
    """Whether the process of this descriptor ends in time; the descriptor is closed."""
    has_ended = bool(select.select([pidfd], [], [], DEADLINE)[0])
    os.close(pidfd)
    return has_ended


@contextmanager
def started(words, **how):
    """A process that is killed at the end: `Popen` itself would wait for it for ever where the test fails."""
    with subprocess.Popen(words, **how) as process:
        try:
            yield process
        finally:
            process.kill()


class Line(str):
    """A line of stderr as a person reads it; `facts` is its log record, empty if it is none."""

    def __new__(cls, line):
        try:
            facts = json.loads(line)
            line = f"{facts['level'].upper()} {facts['message']}\n{facts.get('exception', '')}"
        except (ValueError, TypeError, KeyError):
            facts = {}
        said = super().__new__(cls, line)
        said.facts = facts
        return said

    def is_event(self, event, **facts):
        """Whether it is the record of this event with these facts."""
        return {"event": event, **facts}.items() <= self.facts.items()


class Process(VerbProcess):
    """A running verb that logs as JSON; tests wait for its events."""

    def __init__(self, arguments, cache, inside=(), root=ROOT):
        self._reading = threading.Event()
        self._reading.set()
        self._unread = queue.SimpleQueue()
        said = {**environment(cache, root), "DREAMFLEET_LOG_FORMAT": "json"}
        super().__init__(*arguments, environment=said, inside=inside)

    def freeze(self, size=4096):
        """Stop reading its stderr; `size` more bytes fit into the pipe."""
        fcntl.fcntl(self.popen.stderr, fcntl.F_SETPIPE_SZ, size)
        self._reading.clear()

    def thaw(self):
        """Read on from where `freeze` stopped."""
        self._reading.set()

    def _add_line(self, line):
        self._reading.wait()
        said = Line(line)
        super()._add_line(said)
        self._unread.put(said)

    def wait_for(self, text, times=1, timeout=DEADLINE):
        """Block until stderr has `times` new lines with this datum; returns the last of them."""
        return self._wait(lambda line: text in line, text, times, timeout)

    def events(self, event, **facts):
        """The log's records of this event with these facts so far, the oldest first."""
        return [line.facts for line in self.lines if line.is_event(event, **facts)]

    def wait_for_event(self, event, times=1, timeout=DEADLINE, **facts):
        """Block until the log has `times` new records of this event with these facts; returns the last of them."""
        return self._wait(lambda line: line.is_event(event, **facts), f"{event} {facts}", times, timeout).facts

    def wait_for_report(self, name, timeout=DEADLINE):
        return super().wait_for_report(name, timeout)

    def wait_until_serving(self):
        """Block until it answers at the address that it reports."""
        return self.wait_for_report(ADDRESS)

    def _wait(self, is_wanted, what, times, timeout):
        deadline = time.monotonic() + timeout
        while times:
            has_ended = not any(each.is_alive() for each in self._readers)
            try:
                line = self._unread.get(timeout=POLL_INTERVAL)
            except queue.Empty:
                assert not has_ended, f"it ended before {what!r}:\n{''.join(self.lines)}"
                assert time.monotonic() < deadline, f"no {what!r} within {timeout:g} s:\n{''.join(self.lines)}"
                continue
            times -= is_wanted(line)
        return line

    def finish(self, timeout=DEADLINE):
        return super().finish(timeout)

    def stop(self, number=signal.SIGTERM):
        """Send a signal, and wait for the end: exit code and stdout."""
        self.popen.send_signal(number)
        return self.finish()

    def end(self, timeout=0):
        """End it at once, without a grace period by default."""
        self.thaw()
        super().end(timeout)


class Processes:
    """Children that end with the test."""

    def __init__(self, folder):
        self.folder = folder
        self.port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self.runs = folder / "runs"
        self.cache = folder / "cache"
        self._started = []

    def start(self, *arguments, inside=(), root=ROOT):
        """Start a verb; `inside` is a command prefix that runs it on another host, `root` is its source tree."""
        self._started.append(Process(arguments, self.cache, inside, root))
        return self._started[-1]

    def coordinator(self, *arguments, name="test", at=(), inside=(), root=ROOT):
        """Begin a run, and wait until it is served: at our port, or where the words `at` say."""
        where = at or ("--listen", self.endpoint)
        words = ("coordinator", "--run", name, "--runs-dir", self.runs, "--beat", 0.2, *where, *arguments)
        process = self.start(*words, inside=inside, root=root)
        process.wait_until_serving()
        return process

    def fork(self, source, *flags):
        """Begin a run where another one is, at our port."""
        where = ("--runs-dir", self.runs, "--listen", self.endpoint, "--beat", 0.2)
        return self.start("coordinator", "--from", source, *where, *flags)

    def resume(self, name="test", *flags):
        """Continue a run here; it is served where it was before, unless the flags name another place."""
        return self.start("coordinator", "--resume", name, "--runs-dir", self.runs, *flags)

    def worker(self, *arguments, endpoint=None, inside=(), root=ROOT):
        arguments = ("--connect", endpoint or self.endpoint, "--slots", "1", *arguments)
        return self.start("worker", *arguments, inside=inside, root=root)

    def call(self, *arguments, timeout=DEADLINE):
        """Run a verb to its end: exit code, stdout, stderr."""
        done = subprocess.run(
            command(*arguments), env=environment(self.cache), capture_output=True, check=False, text=True,
            timeout=timeout,
        )  # fmt: skip
        return done.returncode, done.stdout, done.stderr

    def printed(self, *arguments):
        return printed(*arguments, call=self.call)

    def refused(self, datum, *arguments, code=2):
        refused(datum, *arguments, code=code, call=self.call)

    def status(self):
        """The raw status of the only live run; `None` if none answers."""
        try:
            with Client((self.endpoint,)) as client:
                return client.document()
        except ConnectionFailedError:
            return None

    def end(self):
        for process in self._started:
            process.end()


@contextmanager
def processes_in(folder):
    processes = Processes(folder)
    try:
        yield processes
    finally:
        processes.end()
