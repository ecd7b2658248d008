"""What a user's code sees of the command line, and what is said as it fails. Tests trusted_modules.py."""

import json
import subprocess
import sys
from functools import partial
from types import ModuleType

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host import user_code as module
from dreamfleet.common.host.trusted_modules import (
    VARIABLE,
    check_trusted,
    find_attribute,
    import_trusted,
    is_trusted,
    trust,
)
from dreamfleet.common.host.user_code import ARGUMENTS, describe_error, keep_user_arguments, own_arguments, user_code
from dreamfleet.common.protocol.tasks import check_task_trusted, load_task
from dreamfleet.coordinator.optimisers.registry import _find, build_optimiser
from tests.support.processes import environment

OURS = ["/somewhere/bin/dreamfleet", "worker", "--run", "night"]
PARSING = """
import argparse, sys
SEEN = sys.argv
parser = argparse.ArgumentParser()
parser.add_argument("--target", type=float{more})
TARGET = parser.parse_args().target
def cost(x):
    return float(((x - TARGET) ** 2).sum())
class Search:
    options = {{}}
"""
SCRIPT = """
if __name__ == "__main__":
    import dreamfleet
    found = dreamfleet.minimise(cost, [0, 0], 1.0, ftarget=0.5, popsize=8, workers=1)
    print(found.success, found.x.round().tolist())
    with dreamfleet.start_run(
        task="gym:tuning:Pole", optimiser="tuning:Own", population=4, generations=1, evaluate_every=0, workers=1
    ) as run:
        print(run.wait().ended)
"""
OWN = """
from gymnasium.envs.classic_control import CartPoleEnv
from dreamfleet.coordinator.addons.optimisers.cmaes_library import Separable
class Pole(CartPoleEnv):
    pass
class Own(Separable):
    pass
"""


@pytest.fixture
def ours(monkeypatch, tmp_path):
    """A process of a command line of ours, which finds modules in a folder."""
    monkeypatch.setattr(sys, "argv", OURS)
    monkeypatch.delenv(ARGUMENTS, raising=False)
    monkeypatch.setattr(module, "_shows_own", False)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(VARIABLE, "parsing")
    yield tmp_path
    sys.modules.pop("parsing", None)


@pytest.mark.parametrize("given", [[], ["tuning.py", "--target=3"]])
def test_a_module_sees_the_arguments_of_its_program_else_its_name(ours, monkeypatch, given):
    (ours / "parsing.py").write_text(PARSING.format(more=""))
    if given:
        monkeypatch.setenv(ARGUMENTS, json.dumps(given))
    for load, name in ((partial(import_trusted, chooser="x"), "parsing"), (load_task, "function:parsing:cost"),
                       (_find, "parsing:Search")):  # fmt: skip
        sys.modules.pop("parsing", None)
        load(name)
        assert (given or ["parsing"]) == sys.modules["parsing"].SEEN
        assert sys.argv == OURS


@pytest.mark.wording
@pytest.mark.parametrize("module", ["sqlite3.dbapi9", "no_such_module_of_mine", "no_such_package.inside"])
def test_a_module_that_is_not_trusted_is_refused_with_each_remedy_that_is_needed(module, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(UsageError, match=f"--trust.* {VARIABLE}.*{module}") as caught:
        check_trusted(module, "task 'mine'")
    assert ("PYTHONPATH" in str(caught.value)) == module.startswith("no_such")


def test_a_users_program_keeps_its_arguments_and_passes_them_on(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["tuning.py", "--target=3"])
    with user_code("tuning", "importing tuning"):
        assert sys.argv == ["tuning.py", "--target=3"]
    assert own_arguments() == {ARGUMENTS: '["tuning.py", "--target=3"]'}
    monkeypatch.setattr(sys, "argv", ["tuning.py", "x" * 200_000])
    assert own_arguments() == {}, "no process starts with such a variable"
    monkeypatch.setattr(sys, "argv", OURS)
    assert own_arguments() == {}, "what a fleet's process starts is shown what it was given itself"


def test_a_scoring_process_keeps_what_it_shows(ours, monkeypatch):
    monkeypatch.setenv(ARGUMENTS, '["tuning.py"]')
    keep_user_arguments()
    assert sys.argv == ["tuning.py"]
    for kept in (["tuning.py"], ["tuning"]):
        with user_code("tuning", "importing tuning"):
            pass
        assert sys.argv == kept
        monkeypatch.delenv(ARGUMENTS, raising=False)


def test_what_a_module_printed_as_it_exits_is_in_the_error(ours):
    (ours / "parsing.py").write_text(PARSING.format(more=", required=True"))
    with pytest.raises(UsageError) as caught:
        load_task("function:parsing:cost")
    assert "--target" in str(caught.value)
    (ours / "parsing.py").write_text("raise SystemExit('no licence here')")
    with pytest.raises(UsageError, match="no licence here"):
        load_task("parsing:Task")
    assert sys.argv == OURS


def test_a_logger_of_a_module_goes_on_printing_to_the_stream(capfd):
    with user_code("mine", "importing mine"):
        kept = sys.stderr
    print("later", file=kept)
    assert (kept.fileno(), kept.isatty()) == (sys.stderr.fileno(), False)
    assert capfd.readouterr().err == "later\n"


def test_an_error_without_a_text_names_the_users_line(ours):
    (ours / "parsing.py").write_text("x = 1\nassert x > 1\n")
    with pytest.raises(UsageError, match=r"parsing\.py:2"):
        load_task("parsing:Task")
    (ours / "parsing.py").write_text("def make(): json.loads(text)\n")
    assert describe_error(LookupError("three")) == "LookupError: three"
    assert describe_error(AssertionError()) == "AssertionError"


@pytest.mark.slow
def test_a_script_that_parses_its_arguments_at_the_top_searches_and_starts_runs(tmp_path):
    (tmp_path / "tuning.py").write_text(PARSING.format(more=", required=True") + OWN + SCRIPT)
    done = subprocess.run(
        [sys.executable, "tuning.py", "--target", "3"], cwd=tmp_path, env=environment(tmp_path / "cache"),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.splitlines() == ["True [3.0, 3.0]", "1 generation"], done.stderr


CODE = """
import os
import pickle as pp
from functools import partial
from os import system
from pickle import loads, Unpickler
class Holder:
    @staticmethod
    def cost(x):
        return 0.0
def cost(x):
    return 0.0
half = partial(cost)
"""
LOADED = "pickle", "marshal", "os", "posix", "builtins", "numpy", "numpy.lib", "msgspec", "dreamfleet.common.errors"


@pytest.fixture
def program(monkeypatch):
    """A module that the user's program has imported; nothing is trusted by name."""
    monkeypatch.delenv(VARIABLE, raising=False)
    module = ModuleType("my_costs")
    exec(CODE, vars(module))
    monkeypatch.setitem(sys.modules, "my_costs", module)
    return module


@pytest.mark.parametrize("name", LOADED)
def test_no_file_chooses_a_module_because_python_or_this_package_loaded_it(program, name):
    assert name in sys.modules
    assert not is_trusted(name)
    for task in (f"function:{name}:loads", f"{name}:loads"):
        with pytest.raises(UsageError, match=f"--trust {name}"):
            load_task(task)
    with pytest.raises(UsageError, match=f"--trust {name}"):
        build_optimiser(f"{name}:loads", None)  # type: ignore[arg-type]


def test_what_a_users_program_imported_is_trusted_there_and_not_in_a_command_of_ours(program, monkeypatch):
    assert is_trusted("my_costs")
    with monkeypatch.context() as ours:
        ours.setattr(sys, "argv", ["/somewhere/bin/dreamfleet", "evaluate"])
        assert not is_trusted("my_costs")
    load_task("function:my_costs:cost")


def test_a_loaded_module_may_choose_among_environments_of_gymnasium_alone(program):
    check_task_trusted("gym:msgspec:Pole-v0")
    check_task_trusted("gym:Pole-v0")
    with pytest.raises(UsageError, match="--trust unloaded"):
        check_task_trusted("gym:unloaded:Pole-v0")


@pytest.mark.parametrize("name", [
    "os.system", "pp.loads", "system", "loads", "Unpickler", "__builtins__", "__loader__.exec_module", "missing",
    "cost.__globals__",
])  # fmt: skip
def test_no_name_leads_out_of_a_trusted_module(program, name):
    with pytest.raises(AttributeError):
        find_attribute(program, name)
    with pytest.raises(UsageError):
        load_task(f"function:my_costs:{name}")


def test_what_a_trusted_module_has_is_found(program):
    assert find_attribute(program, "Holder.cost") is program.Holder.cost
    assert find_attribute(program, "half") is program.half
    trust(["math"])
    load_task("function:math:fsum")
