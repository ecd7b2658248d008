"""Functions in processes of their own: what comes back of each."""

import os
import signal
import sys
import time
from dataclasses import dataclass

import pytest

from dreamfleet.common.errors import DreamfleetError, RefusedError, StoppedError, UsageError
from dreamfleet.experiments.local import isolated
from dreamfleet.experiments.local.isolated import run_isolated


@dataclass(frozen=True)
class Asked:
    name: str
    size: int = 1


@dataclass(frozen=True)
class Answered:
    text: str
    process: int


def answer(request, stop):
    sys.stdout.write("said\n")
    sys.stderr.write("and noted\n")
    return Answered(request.name * request.size, os.getpid())


def refuse(request, stop):
    raise RefusedError(request.name, ("--any", "yes"))


def misuse(request, stop):
    raise UsageError(request.name)


def crash(request, stop):
    raise ValueError(request.name)


def die(request, stop):
    os.kill(os.getpid(), signal.SIGKILL)


def work_until(stop):
    sys.stderr.write("begun\n")
    while not stop():
        time.sleep(0.01)


def heed(request, stop):
    work_until(stop)
    raise StoppedError("7 of 9 are kept")


def finish_anyway(request, stop):
    work_until(stop)
    return request.name


def ignore(request, stop):
    work_until(lambda: False)


def stopped_once_begun():
    """A `Stop` that turns true with the first line, and what takes that line."""
    seen = []
    return (lambda: bool(seen)), seen.append


def test_a_typed_answer_of_any_size_comes_back_and_what_is_printed_is_logged(tmp_path):
    log, lines = tmp_path / "logs" / "stage.log", []
    found = run_isolated(answer, Asked("ab", 1_000_000), log, on_line=lines.append)
    assert found == Answered("ab" * 1_000_000, found.process)
    assert found.process != os.getpid()
    assert sorted(log.read_text().split("\n")) == ["", "and noted", "said"]


@pytest.mark.parametrize(
    ("function", "kind", "fields"),
    [
        (refuse, RefusedError, {"text": "no", "flag": ("--any", "yes"), "exit_code": 1}),
        (misuse, UsageError, {"args": ("no",), "exit_code": 2}),
    ],
)
def test_an_error_keeps_its_type_and_fields(tmp_path, function, kind, fields):
    with pytest.raises(kind) as raised:
        run_isolated(function, Asked("no"), tmp_path / "log")
    assert type(raised.value) is kind
    assert {name: getattr(raised.value, name) for name in fields} == fields
    assert str(raised.value) in (tmp_path / "log").read_text()


@pytest.mark.parametrize(("function", "code"), [(crash, "1"), (die, "-9")])
def test_another_failure_names_the_log(tmp_path, function, code):
    with pytest.raises(DreamfleetError) as raised:
        run_isolated(function, Asked("no"), tmp_path / "log")
    assert type(raised.value) is DreamfleetError
    assert {function.__name__, code, str(tmp_path / "log")} <= set(str(raised.value).replace(":", "").split(" "))


def test_one_that_is_stopped_says_what_is_kept_or_counts_if_it_finished_all_the_same(tmp_path):
    stop, on_line = stopped_once_begun()
    with pytest.raises(StoppedError) as raised:
        run_isolated(heed, Asked(""), tmp_path / "log", stop, on_line)
    assert raised.value.args == ("7 of 9 are kept",)
    stop, on_line = stopped_once_begun()
    assert run_isolated(finish_anyway, Asked("done"), tmp_path / "log", stop, on_line) == "done"


def test_one_that_does_not_stop_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(isolated, "STOP_TIMEOUT", 0.1)
    stop, on_line = stopped_once_begun()
    with pytest.raises(StoppedError):
        run_isolated(ignore, Asked(""), tmp_path / "log", stop, on_line)
