"""Modules that the user trusts: the only ones that are imported because a file or a message names them.

They stand in an environment variable, so that the processes that this one starts trust the same ones.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from importlib import import_module
from types import ModuleType

from dreamfleet.common.errors import UsageError

VARIABLE = "DREAMFLEET_TRUST"


def trust(modules: Iterable[str]) -> None:
    """Trust these modules, and the modules in those of them that are packages."""
    os.environ[VARIABLE] = ",".join(dict.fromkeys((*_trusted_modules(), *filter(None, modules))))


def is_trusted(module: str) -> bool:
    """Whether a name from elsewhere may choose this module: the user trusts it, or this program has it already."""
    if module in sys.modules:
        return True
    return any(module == each or module.startswith(f"{each}.") for each in _trusted_modules())


def check_trusted(module: str, chooser: str) -> None:
    """`UsageError` unless the module is trusted; `chooser` says what names it, such as `task 'mine:Task'`."""
    if not is_trusted(module):
        raise UsageError(
            f"{chooser} is code in the module {module!r}, which is not trusted here: if you trust that module, pass "
            f"--trust {module}, or {VARIABLE}={module} in the environment"
        )


def import_trusted(module: str, chooser: str) -> ModuleType:
    """Import a module by a name from elsewhere; errors as in `check_trusted`, or those of the import."""
    check_trusted(module, chooser)
    found = import_module(module)
    trust([module])  # also in processes that this one starts, which may not have it yet
    return found


def _trusted_modules() -> tuple[str, ...]:
    return tuple(filter(None, os.environ.get(VARIABLE, "").split(",")))
