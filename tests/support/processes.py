"""Real coordinators and workers as child processes, and waiting for what they do."""

import json
import os
import queue
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

from dreamfleet.common.client import Client

ROOT = Path(__file__).parents[2]
DEADLINE = 60


def free_port():
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def environment(cache):
    inherited = {name: value for name, value in os.environ.items() if name != "SDL_VIDEODRIVER"}  # as people start it
    return {
        **inherited,
        "PYTHONPATH": str(ROOT),
        "DREAMFLEET_CACHE": str(cache),
        "PYTHONUNBUFFERED": "1",
        "COLUMNS": "120",
    }


class Process:
    """A verb running; its stderr lines can be waited for."""

    def __init__(self, arguments, cache, inside=()):
        command = [*inside, sys.executable, "-m", "dreamfleet", *map(str, arguments)]
        self.popen = subprocess.Popen(
            command,
            env=environment(cache),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self.lines = []
        self._queue = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self.popen.stderr:
            self.lines.append(line)
            self._queue.put(line)
        self._queue.put(None)

    def wait_for(self, text, times=1, timeout=DEADLINE):
        """Block until `text` was said on stderr so many times, counted from the last wait."""
        while times:
            line = self._queue.get(timeout=timeout)
            if line is None:
                raise AssertionError(f"ended before saying {text!r}:\n{''.join(self.lines)}")
            times -= text in line

    def finish(self, timeout=DEADLINE):
        """Exit code and stdout."""
        out, _ = self.popen.stdout.read(), self.popen.wait(timeout)
        self._reader.join(timeout)
        return self.popen.returncode, out

    def end(self):
        if self.popen.poll() is None:
            self.popen.kill()
        self.popen.wait()
        self._reader.join(5)
        self.popen.stdout.close()
        self.popen.stderr.close()


class Processes:
    """Children that end with the test."""

    def __init__(self, folder):
        self.folder = folder
        self.port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self.runs = folder / "runs"
        self.cache = folder / "cache"
        self._started = []

    def start(self, *arguments, inside=()):
        """A verb, `inside` a host of its own if given the words that lead there."""
        self._started.append(Process(arguments, self.cache, inside))
        return self._started[-1]

    def coordinator(self, *arguments, name="test"):
        process = self.start(
            "coordinator",
            "--run",
            name,
            "--runs-dir",
            self.runs,
            "--listen",
            self.endpoint,
            "--beat",
            "0.2",
            *arguments,
        )
        process.wait_for("incarnation")
        return process

    def worker(self, *arguments, endpoint=None, inside=()):
        arguments = ("--connect", endpoint or self.endpoint, "--slots", "1", *arguments)
        return self.start("worker", *arguments, inside=inside)

    def call(self, *arguments, timeout=DEADLINE):
        """Run a verb to its end: exit code, stdout, stderr."""
        command = [sys.executable, "-m", "dreamfleet", *map(str, arguments)]
        done = subprocess.run(
            command, env=environment(self.cache), capture_output=True, check=False, text=True, timeout=timeout
        )
        return done.returncode, done.stdout, done.stderr

    def status(self):
        code, out, _ = self.call("status", "--connect", self.endpoint, "--json")
        return json.loads(out) if code == 0 else None

    def statuses(self):
        """Of every live run, those with most slots first."""
        with Client((self.endpoint,)) as client:
            return sorted((client.status(run) for run in client.runs()), key=lambda status: -status.slots)

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
