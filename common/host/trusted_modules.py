"""Modules that the user trusts: the only ones that are imported because a file or a message names them.

They stand in an environment variable, so that the processes that this one starts trust the same ones.
"""

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from inspect import isclass, isroutine
from pathlib import Path
from types import ModuleType
from typing import Any

from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host.packages import allow_swig_types, find_distributions
from dreamfleet.common.host.user_code import describe_error, is_ours, user_code

VARIABLE = "DREAMFLEET_TRUST"
PLACES = "DREAMFLEET_PATH"  # folders of users' modules, for this process and those that it starts
INSTALLED = ("site-packages", "dist-packages")  # folders of installed packages


def trust(modules: Iterable[str]) -> None:
    """Trust these modules, and the modules in those of them that are packages."""
    os.environ[VARIABLE] = ",".join(dict.fromkeys((*_trusted_modules(), *filter(None, modules))))


@contextmanager
def trust_meanwhile() -> Iterator[None]:
    """What is trusted inside is trusted no more afterwards, but for modules that this program has imported by then."""
    before = os.environ.get(VARIABLE)
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(VARIABLE, None)
        else:
            os.environ[VARIABLE] = before


def is_trusted(module: str) -> bool:
    """Whether a name from elsewhere may choose this module: the user trusts it, or the user's program imported it.

    That a module is loaded says nothing of Python's own, of installed packages, or in a command of ours: `pickle.loads`
    runs what the numbers of a controller's file say.
    """
    if any(module == each or module.startswith(f"{each}.") for each in _trusted_modules()):
        return True
    foreign = _is_pythons(module) or module.partition(".")[0] == "dreamfleet" or is_ours()
    return module in sys.modules and not foreign and not find_distributions(module)


def check_trusted(module: str, chooser: str) -> None:
    """`UsageError` unless the module is trusted; `chooser` says what names it, such as `task 'mine:Task'`."""
    if not is_trusted(module):
        harm = "by which a file can do harm, and " * _is_pythons(module)
        raise UsageError(
            f"{chooser} is code in the module {module!r}, {harm}which is not trusted here: if you trust it, pass "
            f"--trust {module}, or {VARIABLE}={module} in the environment{_place_hint(module)}"
        )


def import_trusted(module: str, chooser: str) -> ModuleType:
    """Import a module by a name from elsewhere; errors as in `check_trusted`, `ImportError`s, or `UsageError`."""
    check_trusted(module, chooser)
    allow_swig_types()
    try:
        with user_code(module, f"{chooser}: importing {module}"):
            found = import_module(module)
    except (ImportError, DreamfleetError):
        raise
    except Exception as error:  # a module may raise anything
        raise UsageError(f"{chooser}: importing {module} raised {describe_error(error)}") from error
    trust([module])  # also in processes that this one starts, which may not have it yet
    return found


def find_attribute(module: ModuleType, name: str) -> Any:
    """What a dotted name in a trusted module names; `AttributeError` if it leads out of what is trusted.

    It leads out if it passes another module or Python's internal names, or if what it names is Python's own.
    """
    found: Any = module
    for part in name.split("."):
        found = getattr(found, part)
        if part.startswith("__") or isinstance(found, ModuleType):
            raise AttributeError(f"{part} of {module.__name__} is not code of that module")
    owner = found.__module__ if isroutine(found) or isclass(found) else None
    if owner and _is_pythons(owner) and not _is_pythons(module.__name__):
        raise AttributeError(f"{name} of {module.__name__} is not code of that module, but of {owner}")
    return found


def module_places(module: str) -> tuple[Path, ...]:
    """The file of the top module of this name, or each folder of the package; empty for an unknown or installed one."""
    top = module.partition(".")[0]
    found = sys.modules.get(top)
    try:
        spec = found.__spec__ if found is not None else find_spec(top)  # of a top module nothing is imported
    except (ImportError, ValueError):
        return ()
    file = getattr(spec, "origin", None) or getattr(found, "__file__", None)
    places = list(getattr(spec, "submodule_search_locations", None) or ()) or [file]  # folders only of a package
    if places[0] in (None, "built-in", "frozen") or Path(places[0]).resolve().parent.name in INSTALLED:
        return ()
    return tuple(map(Path, places))


def module_folder(module: str) -> Path | None:
    """The folder to search for a module that this process finds; `None` for an unknown or installed one."""
    places = module_places(module)
    return places[0].resolve().parent if places else None


def search_in(folder: str) -> None:
    """Find modules in this folder too, also in processes that this one starts."""
    if folder:
        os.environ[PLACES] = join_places(folder)
        _extend_path()


def join_places(*folders: str) -> str:
    """The value of `PLACES` with these folders before those that it has."""
    known = os.environ.get(PLACES, "").split(os.pathsep)
    return os.pathsep.join(dict.fromkeys(filter(None, (*folders, *known))))


def _is_pythons(module: str) -> bool:
    return module.partition(".")[0] in sys.stdlib_module_names


def _extend_path() -> None:
    """Search the folders of `PLACES`: behind Python's own modules, and before installed packages."""
    place = next((at for at, each in enumerate(sys.path) if Path(each).name in INSTALLED), len(sys.path))
    new = [each for each in os.environ.get(PLACES, "").split(os.pathsep) if each and each not in sys.path]
    sys.path[place:place] = new


def _place_hint(module: str) -> str:
    """What else it needs, if no module of this name is found; nothing is imported."""
    with suppress(ImportError, ValueError):
        if find_spec(module.partition(".")[0]) is not None:
            return ""
    return "; it is not found here either: name its folder in PYTHONPATH, as the current folder is not searched"


def _trusted_modules() -> tuple[str, ...]:
    return tuple(filter(None, os.environ.get(VARIABLE, "").split(",")))


_extend_path()  # as this is imported: whatever names a user's module, then finds it
