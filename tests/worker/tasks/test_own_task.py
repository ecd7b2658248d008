"""The example package of docs/reference/tasks.md, installed with pip. Tests registry.py."""

import os
import re
import subprocess
import sys

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.tasks.api import Continuous, Task, World
from dreamfleet.worker.tasks.registry import find_task
from tests.support.processes import DEADLINE, ROOT

PROJECT = """
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"
[project]
name = "field"
version = "1.0"
[tool.setuptools]
py-modules = ["field"]
"""


CODE = """
import numpy as np
from dreamfleet import Scorer, TaskSpec
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.protocol.tasks import describe_task
from dreamfleet.worker.tasks.registry import find_task, known_tasks
print("field" in known_tasks(), find_task("field").name, describe_task("field", {}).observations)
scorer = Scorer(TaskSpec("field", "", 20, 0, ControllerShape(2, 2)))
still, inwards = np.zeros(6, np.float32), np.array([-1, 0, 0, -1, 0, 0], np.float32)
print(scorer.score("score", inwards, 3).fitness > scorer.score("score", still, 3).fitness,
      scorer.score("evaluate", inwards, 3).steps)
"""


@pytest.mark.slow
def test_a_package_registers_a_task_that_needs_no_bundle_and_candidates_are_scored_in_it(tmp_path):
    page = (ROOT / "docs" / "reference" / "tasks.md").read_text()
    (module,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (points,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert len(module.splitlines()) - module.count("\n\n") <= 30, "thirty lines, blank ones aside"
    source, target = tmp_path / "source", tmp_path / "site"
    source.mkdir()
    (source / "field.py").write_text(module)
    (source / "pyproject.toml").write_text(PROJECT + points)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", target, source]
    subprocess.run(pip, check=True, timeout=DEADLINE, capture_output=True)
    surroundings = {**os.environ, "PYTHONPATH": f"{target}{os.pathsep}{ROOT}"}
    done = subprocess.run(
        [sys.executable, "-c", CODE], env=surroundings, capture_output=True, text=True, timeout=DEADLINE, check=False
    )
    assert (done.returncode, done.stdout.split()) == (0, ["True", "field", "2", "True", "20"]), done.stderr


class Nameless(Task):
    world = World(Continuous.between([-1], [1]))


class Worldless(Task):
    name = "worldless"

    def make_environment(self, assignment):
        raise AssertionError


class Bare:
    name = "bare"
    batch_size = 0
    world = "none"


@pytest.mark.parametrize(
    ("task", "named"),
    [("Nameless", "make_environment"), ("Worldless", "Worldless"), ("Bare", "make_environment.*make_policy")],
)
def test_an_incomplete_task_is_refused_with_what_is_missing(task, named):
    with pytest.raises(UsageError, match=named):
        find_task(f"{__name__}:{task}")
