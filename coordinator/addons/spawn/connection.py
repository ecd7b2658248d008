"""An ssh connection to a host's agent, with an optional tunnel back, and explanations of ssh's errors."""

import json
import math
import re
import shlex
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.resources import files
from subprocess import PIPE
from time import monotonic
from typing import Any, TypeVar

from dreamfleet.common.errors import ConnectionFailedError, DreamfleetError
from dreamfleet.common.host.child import CommandChild
from dreamfleet.common.printable import one_line
from dreamfleet.common.schema.validation import MAX_TEXT, MalformedError, from_plain
from dreamfleet.coordinator.addons.spawn.agent import MARK

# The user's flags come first, and ssh takes the first value of each option. BatchMode: nobody can type a password.
OPTIONS = ("-T", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10", "-o", "ServerAliveInterval=15",
           "-o", "ServerAliveCountMax=4", "-o", "LogLevel=INFO")  # fmt: skip
# A shared connection would keep the tunnel open after this command.
TUNNEL = ("-o", "ControlMaster=no", "-o", "ControlPath=none", "-o", "ExitOnForwardFailure=yes")
# From the oldest that pyproject.toml supports on, which config.py and messages below name too.
PYTHONS = ("python3", "python3.14", "python3.13", "python3.12", "python3.11", "python")
KEPT_LINES = 50  # of ssh's messages
MAX_MESSAGE = 4096  # bytes kept of one of them
MAX_LINE = 1 << 20  # bytes of an answer, and of all that a host prints beside its answers
MAX_PROGRESS = 1000  # messages of a request's progress
MAX_RENEWALS = 4  # times its `silence` that a request may report progress instead of an answer
QUICK, SLOW = 60.0, 1800.0  # seconds of silence: of an agent that starts or looks, of one that installs or drains
EXIT_TIMEOUT = 5.0  # seconds for ssh to exit
FORWARD = 30.0  # seconds for ssh to report the tunnel's port once the agent runs
_PORT = re.compile(r"Allocated port (\d+) for remote forward to (\S+)")
_BRACKETS = str.maketrans("", "", "[]")  # of an IPv6 address
NO_PYTHON = "dreamfleet-no-python"  # printed by the remote shell before the version found
_SSH_ERRORS = (
    (r"Could not resolve hostname", "no such host: look at its address, or at HostName in ~/.ssh/config"),
    (r"REMOTE HOST IDENTIFICATION HAS CHANGED|Host key for .* has changed",
     "its host key is not the one that is known: if it was reinstalled, remove the old one with `ssh-keygen -R HOST`, "
     "and connect once by hand. Otherwise the connection may be intercepted"),
    (r"Host key verification failed|host key is known",
     "its host key is not known here: connect once by hand, compare what is shown, and accept it"),
    (r"Permission denied \(", "it refuses this user and key: try `ssh {address}` by hand; no password is asked for "
     "here, so load the key into ssh-agent, or name it with --ssh \"ssh -i KEY\""),
    (r"Connection refused", "nothing answers ssh at this address: start sshd there, or give its port: "
     "ssh://HOST:PORT"),
    (r"timed out|No route to host|Network is unreachable|Host is down",
     "it cannot be reached: is it on, and is its network reachable from here?"),
    (r"remote port forwarding failed|administratively prohibited",
     "its sshd allows no tunnel: set AllowTcpForwarding there, or let the coordinator --listen where hosts reach it"),
    (r"Bad configuration option|Bad owner or permissions|terminating, \d+ bad configuration",
     "the ssh client refuses its configuration"),
)  # fmt: skip
_SSH_NOISE = re.compile(r"Warning: Permanently added|^Allocated port|^\s*$|^@+$")

OnMessage = Callable[[str, str], None]
"""Takes a message of the working agent: its kind, `say` or `line`, and the text."""
T = TypeVar("T")


class Connection:
    """A connection to a host's agent; `ConnectionFailedError` says why it failed and what to do."""

    def __init__(self, ssh: Sequence[str], address: str, python: str = "", forwards: Sequence[str] = ()) -> None:
        self._address = shlex.quote(address)  # as commands show it
        program = (files("dreamfleet.coordinator.addons.spawn") / "agent.py").read_bytes()
        tunnel = [word for each in forwards for word in ("-R", f"127.0.0.1:0:{each}")]
        command = _remote_command(python, len(program))
        words = [*ssh, *OPTIONS, *(TUNNEL if forwards else ()), *tunnel, "--", address, command]
        self._stderr_lines: deque[str] = deque(maxlen=KEPT_LINES)
        self._forwards = {each.translate(_BRACKETS): each for each in forwards}  # as ssh names them
        self._ports: dict[str, int] = {}
        self._stray, self._last_stray = 0, ""  # bytes beside answers, and their last line
        self._fault = ""  # why this side ended the connection
        self._changed = threading.Condition()
        try:
            # Its own: it ends as our pipe does, and may leave a shared connection, which is the user's.
            self._child = CommandChild(words, is_own=True, stdin=PIPE, stdout=PIPE, stderr=PIPE)
        except OSError as error:
            raise DreamfleetError(f"{ssh[0]} cannot be run ({error.strerror}): install ssh, or name --ssh") from error
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        self._program = program

    def start_agent(self) -> None:
        """Start the agent and wait for it; `close` from another thread ends the wait."""
        with self._silence_limit(QUICK):
            self._send(self._program)
        self._answer(QUICK, lambda _kind, _text: None)

    def ask(
        self, do: str, answer: type[T], on_message: OnMessage, sent: Mapping[str, bytes], silence: float | None,
        **facts: object,
    ) -> T:  # fmt: skip
        """Send a request and return its answer; `DreamfleetError` if it failed, or after so much `silence`."""
        names = [(name, len(data)) for name, data in sent.items()]
        with self._silence_limit(silence):
            self._send(json.dumps({"do": do, "files": names, **facts}).encode() + b"\n", *sent.values())
        try:
            return from_plain(answer, self._answer(silence, on_message))
        except MalformedError as error:
            self._end(f"its answer to {do!r} does not fit ({error}): what runs there is not the agent of this version")
            raise self._failure() from error

    def interrupt(self) -> None:
        """End a running `follow`. From any thread."""
        self._send(b"\n")

    def ports(self, forwards: Sequence[str]) -> list[int]:
        """The ports on the remote side of the tunnel, in the order of `forwards`."""
        with self._changed:
            if not self._changed.wait_for(
                lambda: self._ports.keys() >= set(forwards) or self._child.exit_code is not None, FORWARD
            ):
                raise ConnectionFailedError("ssh did not say which port its tunnel has: run it without -q")
        if not self._ports.keys() >= set(forwards):
            raise self._failure()
        return [self._ports[each] for each in forwards]

    def close(self) -> None:
        """Close the connection, which ends workers that use its tunnel. From any thread."""
        self._child.end(EXIT_TIMEOUT)
        if self._child.popen.stdin is not None:
            with suppress(OSError):  # what was not read is lost with it
                self._child.popen.stdin.close()

    def release(self) -> None:
        """Close the connection once nobody reads from it any more."""
        self.close()
        assert self._child.popen.stdout is not None
        self._child.popen.stdout.close()

    def _send(self, *data: bytes) -> None:
        assert self._child.popen.stdin is not None
        with suppress(BrokenPipeError, ValueError):  # `_answer` reports why
            for each in data:
                self._child.popen.stdin.write(each)
            self._child.popen.stdin.flush()

    def _answer(self, silence: float | None, on_message: OnMessage) -> dict[str, Any]:
        """The next answer; hands on the messages before it. Only `follow`, of endless patience, has lines of a log."""
        messages = ("failed", "say", "line") if silence is None else ("failed", "say")
        progress, until = 0, math.inf if silence is None else monotonic() + MAX_RENEWALS * silence
        while True:
            with self._silence_limit(silence):
                kind, content = self._read_message()
            if kind == "ok" and isinstance(content, dict):
                return content
            if kind not in messages or not isinstance(content, str):
                self._end("it answers in a form that no agent of this version uses")
                raise self._failure()
            if kind == "failed":
                raise DreamfleetError(one_line(content[:MAX_TEXT]))
            progress += kind == "say"
            if progress > MAX_PROGRESS or monotonic() > until:
                self._end(f"it reports progress without end: {progress} messages, and no answer")
                raise self._failure()
            on_message(kind, content)

    def _read_message(self) -> tuple[Any, Any]:
        """The next line with our mark, parsed; skips what the remote shell prints."""
        assert self._child.popen.stdout is not None
        mark, begins = MARK.encode(), True
        while line := self._child.popen.stdout.readline(MAX_LINE):
            if begins and line.startswith(mark) and line.endswith(b"\n"):
                with suppress(ValueError, RecursionError, AttributeError):
                    ((kind, content),) = json.loads(line[len(mark) :]).items()
                    return kind, content
                return None, None
            begins = line.endswith(b"\n")
            self._stray += len(line)
            self._last_stray = line[:MAX_MESSAGE].decode(errors="replace").strip() or self._last_stray
            if self._stray >= MAX_LINE:
                self._end(
                    f"it prints more than {MAX_LINE >> 20} MiB that are not an answer: `ssh {self._address} true` must "
                    "print nothing, so look at its shell's startup files, such as .bashrc"
                )
        raise self._failure()

    @contextmanager
    def _silence_limit(self, silence: float | None) -> Iterator[None]:
        """End the connection if the block takes longer; `None`: it may take forever."""
        if silence is None:
            yield
            return
        timer = threading.Timer(silence, self._end, (
            f"it does not answer within {silence:.0f} s: `ssh {self._address} true` must end at once, so look at its "
            "shell's startup files, such as .bashrc, and at its load",
        ))  # fmt: skip
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def _end(self, fault: str) -> None:
        """End a connection whose host misbehaves. From any thread."""
        self._fault = self._fault or fault
        self._child.kill()

    def _failure(self) -> ConnectionFailedError:
        if self._fault:
            return ConnectionFailedError(self._fault)
        self._child.wait(EXIT_TIMEOUT)
        self._listener.join(EXIT_TIMEOUT)
        said = [self._last_stray, *self._stderr_lines]
        return ConnectionFailedError(explain(said, self._child.exit_code, self._address))

    def _listen(self) -> None:
        assert self._child.popen.stderr is not None
        while line := self._child.popen.stderr.readline(MAX_MESSAGE):
            text = line.decode(errors="replace").rstrip()
            with self._changed:
                self._stderr_lines.append(text)
                if (found := _PORT.search(text)) and (forward := self._forwards.get(found[2])):
                    self._ports[forward] = int(found[1])
                self._changed.notify_all()
        self._child.popen.stderr.close()
        with self._changed:
            self._changed.notify_all()


def _remote_command(python: str, size: int) -> str:
    """A command for any login shell: run the agent, `size` bytes on stdin, in the first Python that is new enough.

    It holds no line break or exclamation mark, which a C shell would interpret.
    """
    wanted = [python.removeprefix("~/")] if python else list(PYTHONS)
    script = (
        f"for p in {shlex.join(wanted)}; do "
        '"$p" -c "import sys; sys.exit(sys.version_info < (3, 11))" 2>/dev/null </dev/null && '
        f'exec "$p" -P -c "import sys; exec(sys.stdin.buffer.read({size}))"; done; '
        f'echo "{NO_PYTHON} $("${{p:-python3}}" --version 2>&1)" >&2; exit 127'
    )
    return f"exec /bin/sh -c {shlex.quote(script)}"


def explain(said: list[str], code: int | None, address: str) -> str:
    """Why a connection ended and what to do, in one line, from ssh's messages and exit code. Pure."""
    text = "\n".join(said)
    if found := re.search(rf"{NO_PYTHON} (Python [\w.+]+)?", text):
        there = f" (there is {found[1]})" if found[1] else ""
        return f"no Python of 3.11 or newer there{there}: install one, or name it with --remote-python"
    for pattern, remedy in _SSH_ERRORS:
        if re.search(pattern, text):
            return remedy.format(address=address)
    last = next((each.strip() for each in reversed(said) if not _SSH_NOISE.search(each)), "")
    return f"the ssh connection ended{f' ({last})' if last else f', exit code {code}'}: try `ssh {address}` by hand"
