"""Runs a verb in a forked child, without a network, under a time limit, and judges how it ended."""

import ctypes
import fcntl
import os
import resource
import signal
import socket
import struct
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from dreamfleet.common.cli import command_line

PRELOADED = ("numpy", "zenoh", "torch", "onnxruntime", "gymnasium", "pygame", "cma", "matplotlib.pyplot", "rich.live")
SIGNALS = (0.0, signal.SIGINT), (4.0, signal.SIGINT), (20.0, signal.SIGKILL)  # seconds after the limit: Ctrl-C twice
MOST_MEMORY = 3_000_000  # kilobytes
MOST_ADDRESSES = 16_000_000_000  # bytes
MOST_LINES = 6  # of a usage error
CLONE_NEWNET, SIOCSIFFLAGS, IFF_UP, PR_SET_PDEATHSIG = 0x40000000, 0x8914, 1, 1


def preload():
    """Import what verbs import, once for all children."""
    for name in PRELOADED:
        with suppress(ImportError):
            import_module(name)


@dataclass
class Child:
    """A running call."""

    pid: int
    folder: Path
    since: float
    limit: float
    signals: int = 0

    def poll(self):
        """Send the signals that are due; the complaint about the ended call ('' for none), or `None` while it runs."""
        pid, status, usage = os.wait4(self.pid, os.WNOHANG)
        if not pid:
            self._signal(time.monotonic() - self.since - self.limit)
            return None
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        return self._judge(os.waitstatus_to_exitcode(status), usage.ru_maxrss)

    def _signal(self, late):
        for number, (after, sent) in enumerate(SIGNALS):
            if late > after and self.signals == number:
                self.signals += 1
                os.kill(self.pid, sent)

    def _judge(self, code, memory):
        out, err = ((self.folder / name).read_text(errors="replace") for name in ("stdout", "stderr"))
        text, lines = out + err, err.count("\n")
        bugs = "Traceback (most", "panicked at", "Exception ignored", "Fatal Python"
        found = [word for word in bugs if word in text]
        if self.signals == len(SIGNALS):
            found.append("it hangs")
        elif code < 0 and not (self.signals and code == -signal.SIGINT):
            found.append(f"ended by signal {-code}")
        elif code not in (0, 1, 2, 130):
            found.append(f"exit code {code}")
        if memory > MOST_MEMORY:
            found.append(f"{memory / 1e6:.1f} GB of memory")
        if code == 2 and lines > MOST_LINES:
            found.append(f"{lines} lines on stderr")
        return f"{', '.join(found)}\n{text[-1500:]}" if found else ""


def start(argv, folder, limit):
    """Fork a child that runs the verb in `folder`/work; its output goes to files in `folder`."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if not pid:
        code = 70
        try:
            _isolate(folder)
            try:
                code = command_line.main(argv)
            except SystemExit as left:
                code = left.code if isinstance(left.code, int) else int(left.code is not None)
            except BaseException:
                sys.excepthook(*sys.exc_info())
            for stream in (sys.stdout, sys.stderr):
                with suppress(OSError, ValueError):
                    stream.flush()
        finally:
            os._exit(code)
    return Child(pid, folder, time.monotonic(), limit)


def _isolate(folder):
    os.setsid()
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    os.chdir(folder / "work")
    for number, name in enumerate((os.devnull, folder / "stdout", folder / "stderr")):
        os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY if number else os.O_RDONLY, 0o600), number)
    sys.stdout = sys.__stdout__ = open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = sys.__stderr__ = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
    signal.signal(signal.SIGINT, signal.default_int_handler)
    kept = {name: os.environ[name] for name in ("PATH", "LANG", "LC_ALL") if name in os.environ}
    os.environ.clear()
    os.environ.update(kept, HOME=str(folder / "home"), TMPDIR=str(folder / "tmp"), SDL_VIDEODRIVER="dummy")
    resource.setrlimit(resource.RLIMIT_AS, (MOST_ADDRESSES, MOST_ADDRESSES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000_000, 1_000_000_000))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    if ctypes.CDLL(None).unshare(CLONE_NEWNET) == 0:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
            fcntl.ioctl(any_socket, SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", IFF_UP))
