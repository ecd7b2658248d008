"""A user's code as this process runs it: the command line that it sees, and what is said of its errors.

A process of dreamfleet has a command line of ours. A module that reads `sys.argv`, as with argparse at its top level,
must not see that: it sees the arguments of the program that started the run, as with `multiprocessing`, else its own
name alone. Pages: python.md.
"""

import json
import linecache
import os
import sys
import sysconfig
import threading
import traceback
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import one_line

ARGUMENTS = "DREAMFLEET_ARGUMENTS"  # the `sys.argv` of the program that started a run, as JSON
MOST_BYTES = 100_000  # of that: Linux starts no process with a longer variable
KEPT = 400  # characters of what code printed last
_PACKAGE = Path(__file__).parents[2]
_LIBRARIES = tuple(sysconfig.get_path(each) for each in ("purelib", "platlib", "stdlib"))
_swapping = threading.RLock()  # `sys.argv` belongs to all threads
_shows_own = False  # whether this process keeps what it shows to a user's code


def own_arguments() -> dict[str, str]:
    """The variable by which processes that this program starts show its arguments to a user's code."""
    text = json.dumps([str(each) for each in sys.argv])
    return {} if is_ours() or len(text) > MOST_BYTES else {ARGUMENTS: text}


def keep_user_arguments() -> None:
    """Let a user's code see its arguments from now on: this process scores, and needs no command line any more."""
    global _shows_own  # noqa: PLW0603 - one a process
    if is_ours():
        _shows_own = True
        sys.argv = _user_arguments("")


@contextmanager
def user_code(name: str, deed: str) -> Iterator[None]:
    """Run a user's code inside, of the module `name`; it sees its own arguments.

    `UsageError` if it ends the process, with its text or code and what it printed last. `deed` says what it does, such
    as `importing mine`.
    """
    kept: deque[str] = deque(maxlen=KEPT)
    with ExitStack() as stack:
        stack.enter_context(_arguments_shown(name))
        if sys.stdout is not None and sys.stderr is not None:
            stack.enter_context(redirect_stdout(_Copying(sys.stdout, kept)))
            stack.enter_context(redirect_stderr(_Copying(sys.stderr, kept)))
        try:
            yield
        except SystemExit as error:
            code = "" if error.code is None else one_line(f"{error.code!r:.{KEPT}}")
            text = one_line("".join(kept))
            printed = f" and printed {text!r}" if text else ""
            raise UsageError(
                f"{deed} called sys.exit({code}){printed}: put what it does as a program under "
                '`if __name__ == "__main__":`'
            ) from error


def describe_error(error: BaseException) -> str:
    """An exception on one line; without a text of its own, the line of the user's file that raised it."""
    text = one_line(str(error)) or find_user_line(error)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def find_user_line(error: BaseException) -> str:
    """The last line of a user's file that led to the error, else the last of all: `mine.py:12: assert x > 0`."""
    frames = [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    own = [each for each in frames if not each[0].startswith(("<", str(_PACKAGE), *_LIBRARIES))]
    if not frames:
        return ""
    file, line = (own or frames)[-1]
    return one_line(f"{Path(file).name}:{line}: {linecache.getline(file, line)}"[:KEPT]).rstrip(": ")


class _Copying:
    """A stream that keeps what it passes on. A user's logger may hold it for long, so it is like the stream."""

    def __init__(self, stream: Any, kept: deque[str]) -> None:
        self._stream, self._kept = stream, kept

    def write(self, text: str) -> Any:
        """Write the text; as the stream's own."""
        self._kept.extend(text[-KEPT:])
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def _arguments_shown(name: str) -> Iterator[None]:
    if not is_ours():  # a user's own program, whose arguments they are
        yield
        return
    with _swapping:
        before, sys.argv = sys.argv, _user_arguments(name)
        try:
            yield
        finally:
            if not _shows_own:
                sys.argv = before


def is_ours() -> bool:
    """Whether this process runs a command line of ours."""
    started = Path(sys.argv[0]) if sys.argv else Path()
    return _shows_own or started.name == "dreamfleet" or _PACKAGE in started.parents


def _user_arguments(name: str) -> list[str]:
    """What a user's code of this module sees."""
    text = os.environ.get(ARGUMENTS)
    return [str(each) for each in json.loads(text)] if text else [name]
