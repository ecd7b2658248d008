"""Each page's own code and commands work as they stand, from an empty folder and on a small share of their numbers."""

import ast
import json
import os
import re
import sqlite3
import subprocess
import sys
from contextlib import ExitStack, closing
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.support.processes import DEADLINE, ROOT, free_port

WHOLE = 3 * DEADLINE  # seconds that a page's commands may take together
OBJECTIVE = "tutorials/own-objective.md", {}, "tune.png", ()
ENVIRONMENT = (
    "tutorials/own-environment.md",
    {
        "--generations 30 --evaluate-every 10": "--generations 2 --population 4 --evaluate-every 1"
        " --evaluation-episodes 2 --confirm-episodes 2",
        "--episodes 100": "--episodes 2",
    },
    "runs/drone/controller.npz runs/hidden/controller.npz drone-fitness.png drive.mp4",
    ("6 observations, 2 outputs", "gym:my_drone:Drone-v0", "hidden.json", "linear.json"),
)
WORLD = (
    "tutorials/own-world-model.md",
    {
        "--scale 0.5": "--scale 0.005 --jobs 1 --yes",
        "--episodes 1000": "--episodes 8",
        "--updates 1500": "--updates 8",
        "--survival": "--survival --episodes 4",
        "--generations 60": "--generations 2 --population 4 --episodes 2 --evaluate-every 1 --confirm-episodes 2",
        "--episodes 100": "--episodes 2",
    },
    "data/pixels.zip inspection/index.html runs/canyon/controller.npz drive.mp4",
    ("gym:my_world:Canyon-v0",),
)
QUALITY_DIVERSITY = (
    "how-to/quality-diversity.md",
    {"--population 48 --episodes 2 --generations 40": "--population 12 --episodes 1 --generations 3",
     "--episodes 20": "--episodes 2"},
    "swing-archive.png swing-csv/elites.npz",
    (" of 144 ",),
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(WHOLE + 60)
@pytest.mark.parametrize(
    ("page", "shares", "made", "printed"),
    [OBJECTIVE, ENVIRONMENT, WORLD, QUALITY_DIVERSITY],
    ids=["objective", "environment", "world", "quality-diversity"],
)
def test_a_pages_commands_work_as_they_stand(tmp_path, page, shares, made, printed):
    found = run_page(page, shares, tmp_path)
    assert [text for text in printed if text not in found] == []
    for name in made.split():
        assert (tmp_path / name).stat().st_size > 100


@pytest.mark.slow
def test_every_cell_of_the_notebook_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(ROOT / "docs" / "tutorials" / "notebook.ipynb", as_version=4)
    NotebookClient(notebook, timeout=DEADLINE, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", ())]
    assert [sum(kind in data for data in shown) for kind in ("image/png", "text/html")] == [2, 2]


def run_page(page, shares, folder):
    """What a page's commands print, but for its first block, which installs; its Python is the module that it names."""
    text = (ROOT / "docs" / page).read_text()
    for code in _blocks(text, "python"):
        (module,) = set(re.findall(r"`(\w+\.py)`", text))
        (folder / module).write_text(code)
    install, *commands = _blocks(text, "sh")
    assert "pip install" in install
    script = "".join(commands)
    for whole, share in shares.items():
        assert whole in script
        script = script.replace(whole, share)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    own = {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", "OMP_NUM_THREADS": "1",
        "DREAMFLEET_CACHE": str(folder / "cache"), "DREAMFLEET_LISTEN": endpoint, "DREAMFLEET_CONNECT": endpoint,
    }  # fmt: skip
    done = subprocess.run(
        ("bash", "-ec", script), cwd=folder, env={**os.environ, **own}, capture_output=True, text=True,
        timeout=WHOLE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def _blocks(text, language):
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


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
