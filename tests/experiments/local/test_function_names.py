"""The name under which other processes find a function, or what to do if there is none."""

import os
import subprocess
import sys
import types
from functools import partial
from operator import attrgetter

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.trusted_modules import PLACES
from dreamfleet.experiments.local.function_names import IMPORTED_FOR, environment_for, name_function
from tests.support import objectives
from tests.support.processes import ROOT

MODULE = "tests.support.objectives"


def test_a_function_of_a_module_travels_by_its_name():
    found = name_function(objectives.sphere)
    assert found.folder == ROOT.resolve()
    assert found.environment[PLACES].split(os.pathsep)[0] == str(found.folder)
    for name in ("sphere", "Shifted.value", "Shifted.of_class", "steady", "weighted", "weighted.noisy"):
        assert name_function(attrgetter(name)(objectives)).task == f"function:{MODULE}:{name}"
    assert name_function("mine:cost").task == name_function("function:mine:cost").task == "function:mine:cost"


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x,
        objectives.outer(),
        objectives.Shifted().method,
        partial(objectives.noisy, seed=1),
        objectives.Weighted(2),
        3,
    ],
)
def test_what_other_processes_would_not_find_is_refused_with_what_to_do(function):
    with pytest.raises(UsageError, match="`def`"):
        name_function(function)


def test_a_module_that_searches_as_it_is_imported_is_refused(monkeypatch):
    monkeypatch.setenv(IMPORTED_FOR, f"function:{MODULE}:sphere")
    with pytest.raises(UsageError, match="__main__"):
        name_function(objectives.sphere)
    assert name_function(objectives.noisy)


SCRIPT = """
import functools
from dreamfleet.experiments.local.function_names import name_function
def cost(x, weight=1): return 0.0
heavy = functools.partial(cost, weight=9)
print(name_function(cost).task, name_function(heavy).task)
"""


@pytest.mark.parametrize(
    ("file", "expected"), [("tuning.py", "function:tuning:cost function:tuning:heavy"), ("my-tuning.py", "UsageError")]
)
def test_a_scripts_own_function_is_found_by_the_name_of_its_file(tmp_path, file, expected):
    (tmp_path / file).write_text(SCRIPT)
    done = subprocess.run([sys.executable, file], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert expected in done.stdout + done.stderr


def test_a_function_of_a_notebooks_cell_is_to_be_put_into_a_file(monkeypatch):
    monkeypatch.setitem(sys.modules, "__main__", types.ModuleType("__main__"))  # as a kernel's: it has no file
    names = {"__name__": "__main__"}
    exec("def cost(x): return 0.0", names)
    with pytest.raises(UsageError, match="cost"):
        name_function(names["cost"])


def test_a_module_beside_the_script_is_found_though_nothing_imported_it(tmp_path, monkeypatch):
    (tmp_path / "beside.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv(PLACES, raising=False)
    assert environment_for(("gym:beside:Catch-v0", None)) == {PLACES: str(tmp_path)}
    assert environment_for(("gym:CartPole-v1", "cma", "gym:nowhere:Catch-v0", "function:numpy.linalg:norm")) == {}


BESIDE = """
import dreamfleet.common.host.trusted_modules, statistics, sys, tuning
print(statistics.fmean([1, 3]), tuning.cost(0))
"""


def test_a_file_called_like_a_module_of_python_replaces_that_in_no_other_process(tmp_path, monkeypatch):
    (tmp_path / "statistics.py").write_text("raise SystemExit('of the user')\n")
    (tmp_path / "tuning.py").write_text("def cost(x): return 7\n")
    monkeypatch.syspath_prepend(tmp_path)
    variables = {**os.environ, **environment_for(("function:tuning:cost",)), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", BESIDE], env=variables, capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.stdout.split() == ["2.0", "7"], done.stderr
    monkeypatch.delitem(sys.modules, "statistics")
    with pytest.raises(UsageError, match="'statistics'"):
        environment_for(("function:statistics:cost",))
    assert name_function("math:fsum").task == "function:math:fsum"
