"""One ssh connection: the agent that runs behind it is asked, and answers; a tunnel may go the other way."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.resources import files
from typing import Any

from dreamfleet.common.errors import ConnectionFailedError, DreamfleetError
from dreamfleet.coordinator.spawn.agent import MARK
from dreamfleet.coordinator.spawn.ssh_errors import NO_PYTHON, explain

# The user's own flags stand before these, and ssh takes the first of each. Nobody is there to be asked for a password.
OPTIONS = ("-T", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10", "-o", "ServerAliveInterval=15",
           "-o", "ServerAliveCountMax=4", "-o", "LogLevel=INFO")  # fmt: skip
# A connection that others share would keep the tunnel after this command.
TUNNEL = ("-o", "ControlMaster=no", "-o", "ControlPath=none", "-o", "ExitOnForwardFailure=yes")
PYTHONS = ("python3", "python3.14", "python3.13", "python3.12", "python3.11", "python")
KEPT_LINES = 50  # of what ssh says
PATIENCE = 5.0  # seconds that ssh may take to end
FORWARD = 30.0  # seconds until ssh says which port it was given, once the other side runs
_PORT = re.compile(r"Allocated port (\d+) for remote forward to (\S+)")

OnMessage = Callable[[str, str], None]
"""What the agent says while it works: `say` or `line`, and the text."""


def _ignore_message(_kind: str, _text: str) -> None:
    """Nobody listens."""


class Connection:
    """A host's agent; where none answers, `ConnectionFailedError` says why, and what to do."""

    def __init__(self, ssh: Sequence[str], address: str, python: str = "", forwards: Sequence[str] = ()) -> None:
        self._address = address
        program = (files("dreamfleet.coordinator.spawn") / "agent.py").read_bytes()
        tunnel = [word for each in forwards for word in ("-R", f"127.0.0.1:0:{each}")]
        words = [
            *ssh,
            *OPTIONS,
            *(TUNNEL if forwards else ()),
            *tunnel,
            "--",
            address,
            _remote_command(python, len(program)),
        ]
        self._stderr_lines: deque[str] = deque(maxlen=KEPT_LINES)
        self._ports: dict[str, int] = {}
        self._changed = threading.Condition()
        try:
            self._popen = subprocess.Popen(  # noqa: S603 - the user's ssh client
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
            )
        except OSError as error:
            raise DreamfleetError(
                f"{ssh[0]} cannot be run ({error.strerror}): install an ssh client, or name --ssh"
            ) from error
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        self._program = program

    def start_agent(self) -> None:
        """Have the agent run, which may be waited for: whoever waits can be ended by `close`."""
        self._send(self._program)
        self._answer(_ignore_message)

    def ask(
        self, do: str, on_message: OnMessage = _ignore_message, sent: Mapping[str, bytes] | None = None, **facts: Any
    ) -> Any:
        """Have one thing done; `DreamfleetError` if it cannot be."""
        names = [(name, len(data)) for name, data in (sent or {}).items()]
        self._send(json.dumps({"do": do, "files": names, **facts}).encode() + b"\n", *(sent or {}).values())
        return self._answer(on_message)

    def interrupt(self) -> None:
        """End a `follow` that is under way. From any thread."""
        self._send(b"\n")

    def ports(self, forwards: Sequence[str]) -> list[int]:
        """The ports there of the tunnel's ends, in order."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._ports.keys() >= set(forwards) or self._ended, FORWARD):
                raise ConnectionFailedError("ssh did not say which port its tunnel was given")
        if not self._ports.keys() >= set(forwards):
            raise self._failure()
        return [self._ports[each] for each in forwards]

    def close(self) -> None:
        """End it, and with it what lives by its tunnel. From any thread."""
        with suppress(OSError):
            self._popen.terminate()
        try:
            self._popen.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()

    @property
    def _ended(self) -> bool:
        return self._popen.poll() is not None

    def _send(self, *data: bytes) -> None:
        assert self._popen.stdin is not None
        with suppress(BrokenPipeError, ValueError):  # what is answered, or not, says why
            for each in data:
                self._popen.stdin.write(each)
            self._popen.stdin.flush()

    def _answer(self, on_message: OnMessage) -> Any:
        """The next answer; lines without our mark are of the other side's shell."""
        assert self._popen.stdout is not None
        for line in self._popen.stdout:
            if not line.startswith(MARK.encode()):
                continue
            ((kind, told),) = json.loads(line[len(MARK) :]).items()
            if kind == "ok":
                return told
            if kind == "failed":
                raise DreamfleetError(told)
            on_message(kind, told)
        raise self._failure()

    def _failure(self) -> ConnectionFailedError:
        with suppress(subprocess.TimeoutExpired):
            self._popen.wait(PATIENCE)
        self._listener.join(PATIENCE)
        return ConnectionFailedError(explain(list(self._stderr_lines), self._popen.poll(), self._address))

    def _listen(self) -> None:
        assert self._popen.stderr is not None
        for line in self._popen.stderr:
            text = line.decode(errors="replace").rstrip()
            with self._changed:
                self._stderr_lines.append(text)
                if found := _PORT.search(text):
                    self._ports[found[2]] = int(found[1])
                self._changed.notify_all()
        with self._changed:
            self._changed.notify_all()


def _remote_command(python: str, size: int) -> str:
    """For whatever shell is there: run the agent, of so many bytes on stdin, in the first Python that is new enough.

    No line break and no exclamation mark, which a C shell would take for its own.
    """
    wanted = [python.removeprefix("~/")] if python else list(PYTHONS)
    script = (
        f"for p in {shlex.join(wanted)}; do "
        '"$p" -c "import sys; sys.exit(sys.version_info < (3, 11))" 2>/dev/null </dev/null && '
        f'exec "$p" -P -c "import sys; exec(sys.stdin.buffer.read({size}))"; done; '
        f'echo "{NO_PYTHON} $("${{p:-python3}}" --version 2>&1)" >&2; exit 127'
    )
    return f"exec /bin/sh -c {shlex.quote(script)}"
