"""A Python function by a name under which other processes find it: functions never travel as pickles.

Pages: own-objective.md, tasks.md.
"""

import inspect
import os
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

from dreamfleet.common.artifacts.objective import takes_seed
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.trusted_modules import PLACES, join_places, module_folder
from dreamfleet.common.protocol.tasks import FUNCTION, module_of

REMEDY = "write it as `def`, a partial function or an object at the top level of a module, and pass that"
MAIN = "__main__"
IMPORTED_FOR = "DREAMFLEET_FUNCTION"  # the task for which a process of a fleet imports modules


@dataclass(frozen=True)
class FunctionName:
    """The task `function:MODULE:NAME`, and the folder in which its module lies; `None` if that is installed."""

    task: str
    folder: Path | None

    @property
    def environment(self) -> dict[str, str]:
        """Variables by which processes of this host find the module, and know why they import it."""
        return {IMPORTED_FOR: self.task, **_path_with(self.folder)}


def environment_for(names: Iterable[object]) -> dict[str, str]:
    """The variables by which processes of this host find the modules in these names of tasks and optimisers.

    `UsageError` for a module that is called like one of Python's own.
    """
    modules = [module_of(name) for name in names if isinstance(name, str)]
    for module in filter(None, modules):
        _check_module_name(module)
    return _path_with(*(module_folder(module) for module in modules if module))


def _check_module_name(module: str) -> None:
    """`UsageError` for a user's module that is called like one of Python's own, which other processes import instead.

    In `PYTHONPATH` it would replace Python's own one in each process, and end most of them.
    """
    top, folder = module.partition(".")[0], module_folder(module)
    if top in sys.stdlib_module_names and folder and not folder.is_relative_to(Path(os.__file__).resolve().parent):
        raise UsageError(
            f"the module {top!r} in {folder} is called like one of Python's own, which other processes would import "
            "instead: give it another name"
        )


def _path_with(*folders: Path | None) -> dict[str, str]:
    more = [str(each) for each in folders if each is not None]
    return {PLACES: join_places(*more)} if more else {}


def name_function(function: Callable[..., Any] | str) -> FunctionName:
    """The name of a function of a module, or of a script's own if its file can be imported as a module.

    It may also be a partial function or an object that a module names at its top level, or a method of one; or the text
    `MODULE:NAME`. `UsageError` says what to do about lambdas, nested functions, objects without such a name, and
    functions of a notebook; also where a script searches as it is imported.

    >>> import numpy as np
    >>> name_function(np.linalg.norm).task
    'function:numpy.linalg:norm'
    """
    if isinstance(function, str):
        own = function.removeprefix(f"{FUNCTION}:")
        found = FunctionName(f"{FUNCTION}:{own}", module_folder(function.partition(":")[0]))
    else:
        found = _name_object(function)
    _check_module_name(found.task.split(":")[1])
    if os.environ.get(IMPORTED_FOR) == found.task:
        raise UsageError(
            "a process of the fleet imports this module to call its function, and the module then searches again: put "
            'the search under `if __name__ == "__main__":`'
        )
    return found


def _name_object(function: Callable[..., Any]) -> FunctionName:
    if not callable(function):
        raise UsageError(f"{type(function).__name__} is no function of a module: {REMEDY}")
    if inspect.ismethod(function) and not inspect.isclass(function.__self__):
        return _name_instance(function.__self__, f".{function.__name__}")
    module, name = getattr(function, "__module__", None), getattr(function, "__qualname__", None)
    if not module or not name:
        return _name_instance(function)
    if "<lambda>" in name or "<locals>" in name:
        kind = "a lambda" if "<lambda>" in name else "a function inside of another"
        raise UsageError(f"{kind} has no name by which other processes find it: {REMEDY}")
    if module == MAIN:
        return _name_of_script(name)
    found = None
    with suppress(AttributeError):
        found = attrgetter(name)(sys.modules.get(module))
    if found is not function and not (inspect.ismethod(function) and found == function):
        raise UsageError(f"{name} of {module} is another object than this function: {REMEDY}")
    return FunctionName(f"{FUNCTION}:{module}:{name}", module_folder(module))


def _name_instance(found: object, more: str = "") -> FunctionName:
    """The name of an object, such as a partial function, under which a module has it; `more` follows that."""
    kind = type(found)
    first = getattr(found.func, "__module__", "") if isinstance(found, partial) else kind.__module__
    places = dict.fromkeys((first, *sys.modules, MAIN))
    if first != MAIN:  # last: of a notebook nothing is found elsewhere
        places[MAIN] = places.pop(MAIN)
    for module in places:
        for name, value in list(getattr(sys.modules.get(module), "__dict__", {}).items()):
            if value is found and module == MAIN:
                return _name_of_script(name + more)
            if value is found:
                return FunctionName(f"{FUNCTION}:{module}:{name}{more}", module_folder(module))
    raise UsageError(f"no module has this object of type {kind.__name__} under a name: {REMEDY}")


def _name_of_script(name: str) -> FunctionName:
    """The name of a function of the running program: its file is imported as a module, as `multiprocessing` does."""
    main = sys.modules["__main__"]
    spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    if spec is not None:  # python -m package.module
        return FunctionName(f"{FUNCTION}:{spec.name}:{name}", Path.cwd())
    if file is None or Path(file).suffix != ".py" or not Path(file).stem.isidentifier():
        where = "a notebook or a prompt" if file is None else f"{Path(file).name}, which cannot be imported"
        raise UsageError(
            f"{name} is defined in {where}, where other processes do not find it: write it into a file such as "
            f"objectives.py, and pass `objectives.{name}` after `import objectives`"
        )
    path = Path(file).resolve()
    return FunctionName(f"{FUNCTION}:{path.stem}:{name}", path.parent)


def is_noisy(function: Callable[..., Any] | str) -> bool:
    """Whether it has a second parameter `seed`; `UsageError` for a name that is no function here."""
    if not isinstance(function, str):
        return takes_seed(function)
    module, _, name = function.rpartition("function:")[2].partition(":")
    try:
        return takes_seed(attrgetter(name)(import_module(module)))
    except (ImportError, AttributeError) as error:
        raise UsageError(f"no function {name} of module {module} here: {error}") from error
