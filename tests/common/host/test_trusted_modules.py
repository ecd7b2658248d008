import sys
from types import ModuleType

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.trusted_modules import VARIABLE, find_attribute, is_trusted, trust
from dreamfleet.common.protocol.tasks import check_task_trusted, load_task
from dreamfleet.coordinator.optimisers.registry import build_optimiser

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
