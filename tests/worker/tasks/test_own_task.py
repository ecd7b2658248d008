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


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder that the package was installed in."""
    page = (ROOT / "docs" / "reference" / "tasks.md").read_text()
    (module,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (points,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert len(module.splitlines()) - module.count("\n\n") <= 30, "thirty lines, blank ones aside"
    source, target = tmp_path_factory.mktemp("field"), tmp_path_factory.mktemp("site")
    (source / "field.py").write_text(module)
    (source / "pyproject.toml").write_text(PROJECT + points)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(target), str(source)]
    subprocess.run(pip, check=True, timeout=DEADLINE, capture_output=True)
    return target


def run(code, *folders):
    path = os.pathsep.join(map(str, (*folders, ROOT)))
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True,
        timeout=DEADLINE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.slow
def test_a_package_registers_a_task_that_needs_no_bundle(installed):
    code = """
from dreamfleet.common.protocol.tasks import describe_task
from dreamfleet.worker.tasks.registry import find_task, known_tasks
print("field" in known_tasks(), find_task("field").name, describe_task("field", {}).observations)
"""
    assert run(code, installed) == "True field 2"


@pytest.mark.slow
def test_candidates_are_scored_in_it(installed):
    code = """
import numpy as np
from dreamfleet import Scorer, TaskSpec
from dreamfleet.common.artifacts.controller import ControllerShape
shape = ControllerShape(2, 2)
scorer = Scorer(TaskSpec("field", "", 20, 0, shape))
still, inwards = np.zeros(6, np.float32), np.array([-1, 0, 0, -1, 0, 0], np.float32)
print(scorer.score("score", inwards, 3).fitness > scorer.score("score", still, 3).fitness,
      scorer.score("evaluate", inwards, 3).steps)
"""
    assert run(code, installed) == "True 20"


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
