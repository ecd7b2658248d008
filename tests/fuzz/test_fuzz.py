"""The fuzz itself: a few of its calls end well, and it sees what it is there to find."""

import os
import random
import shutil
import signal
import sys
import time

import pytest

from dreamfleet.common.cli import command_line
from tests.fuzz.__main__ import draw_calls, run_calls
from tests.fuzz.calls import Call, one_value_calls, parsers, write_stage
from tests.fuzz.forked import start

LIMIT = 5.0  # seconds until a call is interrupted


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    return write_stage(tmp_path_factory.mktemp("fuzz") / "stage")


def test_the_calls_follow_from_the_seed():
    verbs = parsers("runs.")
    assert draw_calls(verbs, 50, random.Random(3)) == draw_calls(verbs, 50, random.Random(3))
    assert Call("runs.list", ("--runs-dir=nan",)) in list(one_value_calls("runs.list", verbs["runs.list"]))


@pytest.mark.slow
def test_verbs_take_empty_values(stage):
    """Of the verbs that end by themselves."""
    calls = [call for name, parser in parsers("runs.").items() for call in one_value_calls(name, parser, ("",))]
    assert len(calls) > 20
    assert [(call.argv, found) for call, found in run_calls(calls, stage, 2, LIMIT) if found] == []


@pytest.mark.parametrize(
    ("bug", "limit", "found"),
    [
        (lambda _words: 1 // 0, LIMIT, "Traceback"),
        (lambda _words: os.kill(os.getpid(), signal.SIGUSR1), LIMIT, f"ended by signal {signal.SIGUSR1:d}"),
        (lambda _words: sys.stderr.write("usage\n" * 7) and 2, LIMIT, "7 lines on stderr"),
        (lambda _words: 3, LIMIT, "exit code 3"),
        (lambda _words: 0, LIMIT, ""),
        (lambda _words: time.sleep(300), 1.0, "Traceback"),
    ],
)
def test_it_sees_what_it_is_there_to_find(bug, limit, found, tmp_path, monkeypatch):
    monkeypatch.setattr(command_line, "main", bug)
    for name in ("work", "home", "tmp"):
        (tmp_path / name).mkdir()
    child = start([], tmp_path, limit)
    while (complaint := child.poll()) is None:
        time.sleep(0.01)
    assert found in complaint
    assert bool(found) == bool(complaint)
    shutil.rmtree(tmp_path)
