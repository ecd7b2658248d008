"""docs/explanation/miniature.py: what is killed changes no bit, and the file is short enough to be read at once."""

import ast
import json
import os
import sqlite3
import subprocess
import sys
from contextlib import ExitStack, closing

import pytest

from tests.support.processes import DEADLINE, ROOT, free_port

SCRIPT = ROOT / "docs" / "explanation" / "miniature.py"
MOST_LINES, MOST_LINES_OF_A_FUNCTION = 150, 20
GENERATIONS, POPULATION, CREDIT = 30, 8, 2


@pytest.fixture
def play(tmp_path):
    """Start one process of the system, in a folder of its run."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    for unused in ("matplotlib", "scipy"):  # which cma imports, for seconds
        (tmp_path / f"{unused}.py").write_text("raise ImportError")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}

    def start(run, role, *flags):
        folder = tmp_path / run
        folder.mkdir(exist_ok=True)
        words = (sys.executable, SCRIPT, role, "--endpoint", endpoint, *flags)
        popen = started.enter_context(
            subprocess.Popen(words, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True)
        )
        started.callback(popen.kill)
        return popen

    with ExitStack() as started:
        yield start


def finish(*processes):
    """The lines of each process."""
    said = [process.communicate(timeout=DEADLINE)[0].splitlines() for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes)
    return said


@pytest.mark.slow
def test_a_worker_and_a_coordinator_killed_in_the_middle_of_a_job_change_no_bit(play, tmp_path):
    undisturbed, _ = finish(play("calm", "coordinator"), play("calm", "worker", "--seconds", "0"))
    first, lost = play("wild", "coordinator"), play("wild", "worker", "--seconds", "1000")
    scored = [lost.stdout.readline() for _ in range(CREDIT)]
    ((status,),) = finish(play("wild", "status"))
    assert len(json.loads(status)["candidates"]) == POPULATION
    assert json.loads(status)["candidates"].count("queued") == POPULATION - CREDIT
    lost.kill()
    worker = play("wild", "worker", "--seconds", "0.01")
    for _ in range(3):
        first.stdout.readline()
    first.kill()
    first.wait(DEADLINE)
    disturbed, again = finish(play("wild", "coordinator"), worker)
    assert disturbed[-1] == undisturbed[-1]
    assert disturbed[-1].count("0x") == POPULATION
    assert set(scored) <= {f"{line}\n" for line in again}
    with closing(sqlite3.connect(tmp_path / "wild" / "miniature.sqlite")) as journal:
        assert journal.execute("SELECT count(*) FROM result").fetchone() == (GENERATIONS * POPULATION,)


def test_it_is_read_at_once():
    text = SCRIPT.read_text()
    functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    assert len(text.splitlines()) <= MOST_LINES
    assert max(node.end_lineno - node.lineno + 1 for node in functions) <= MOST_LINES_OF_A_FUNCTION
    assert "fmt: " not in text
