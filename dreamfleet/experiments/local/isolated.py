"""A function in a process of its own: a typed answer or a typed error over a pipe, its log beside.

Pages: platforms.md.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

from dreamfleet.common.errors import DreamfleetError, StoppedError
from dreamfleet.common.host.child import FunctionChild
from dreamfleet.common.host.logs import configure_logging, report_failure
from dreamfleet.common.host.standard_streams import prepare_streams
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.common.host.user_code import keep_user_arguments

POLL_INTERVAL = 0.1  # seconds between two looks whether to stop, and at the log
STOP_TIMEOUT = 15.0  # seconds that a function has to end once asked: a training finishes its update first
Request = TypeVar("Request")
Report = TypeVar("Report")
Answer = tuple[Any, DreamfleetError | None]


def run_isolated(
    function: Callable[[Request, Stop], Report], request: Request, log: Path, stop: Stop = never_stop,
    on_line: Callable[[str], None] = lambda _line: None,
) -> Report:  # fmt: skip
    """What `function(request, stop)` returns in a spawned process, which ends with this one at the latest.

    The process prints into the file `log`, and `on_line` gets each line of that. A `DreamfleetError` is raised here
    too, with its type and fields. Once `stop` is true, the function's own is, and it has `STOP_TIMEOUT` seconds to end.
    Else it is killed with what it started: `StoppedError`. Any other failure is a `DreamfleetError` that names the log.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    log.write_bytes(b"")
    answers: list[Answer | None] = []
    level, asked = min(logging.getLogger("dreamfleet").getEffectiveLevel(), logging.INFO), None
    with (
        log.open(encoding="utf-8", errors="replace") as lines,
        FunctionChild(_answer, function, request, log.absolute(), level, on_message=answers.append) as child,
    ):
        has_ended = False
        while not has_ended:
            has_ended = child.wait(POLL_INTERVAL)
            for line in lines:
                on_line(line.strip())
            if asked is None and stop():
                asked = monotonic()
                child.send(None)
            elif asked is not None and monotonic() > asked + STOP_TIMEOUT:
                child.kill()
        code = child.exit_code
    for answer in answers:
        if answer is not None:
            report, error = answer
            if error is not None:
                raise error
            return report  # type: ignore[no-any-return]
    if asked is not None:
        raise StoppedError("stopped")
    printed = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    last = printed[-1].strip() if printed else "it printed nothing"
    raise DreamfleetError(f"{function.__name__} ended with {code}: {last}; its log is {log}")


def _answer(
    pipe: Connection[Any, Answer], function: Callable[[Any, Stop], Any], request: Any, log: Path, level: int
) -> None:
    """Call the function in the child; the parent asks it to stop by a message, or by its end."""
    opened = os.open(log, os.O_WRONLY | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(opened, stream)
    os.close(opened)
    prepare_streams()
    configure_logging()
    logging.getLogger("dreamfleet").setLevel(level)
    keep_user_arguments()
    try:
        pipe.send((function(request, pipe.poll), None))
    except DreamfleetError as error:
        report_failure(str(error))
        pipe.send((None, error))
