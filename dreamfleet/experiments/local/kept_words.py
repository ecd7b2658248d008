"""Which code the words of a kept document may choose, by docs/how-to/trust.md: its folder may be somebody else's.

Such words become flags of child processes, and a child trusts each module that its flags name.
"""

import argparse
import json
from collections.abc import Iterable, Mapping
from hashlib import sha256
from pathlib import Path

from dreamfleet.common.addons.own_modules import trust_own_run
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.trusted_modules import check_trusted, trust
from dreamfleet.common.protocol.tasks import module_of
from dreamfleet.common.runs.own_runs import remember_run


def chosen_code(parsed: argparse.Namespace) -> dict[str, str]:
    """The modules that parsed flags have a process trust, by the words that name each; empty for a file of settings."""
    names = {setting: getattr(parsed, setting, None) for setting in ("task", "optimiser")}
    found = {f"{setting} {name!r}": module_of(name) for setting, name in names.items() if name and module_of(name)}
    found |= {f"--trust {module!r}": module for module in getattr(parsed, "trust", None) or ()}
    return found | ({f"--config {str(parsed.config)!r}": ""} if parsed.config is not None else {})


def accept(words: object, code: Mapping[str, str]) -> None:
    """Trust the modules that words of this user choose, and note that this user gave these words on this host."""
    trust(code.values())
    for module in filter(None, code.values()):
        remember_run(_uid(words, module), f"{module}:", "")


def check_kept(words: object, code: Mapping[str, str], keeper: Path) -> None:
    """`UsageError` unless each module that the words in `keeper` choose is trusted, or this user gave the words here.

    A file of settings is refused: it may name any code.
    """
    for name, module in code.items():
        if not module:
            raise UsageError(f"{keeper} has {name}: give the flags that name it again, if you trust that file")
        trust_own_run(_uid(words, module), f"{module}:", "")
        check_trusted(module, f"{keeper}: {name}")


def check_announced(tasks: Iterable[str]) -> None:
    """`UsageError` unless the modules of these tasks are trusted: a worker trusts what it is made to announce.

    A world model's file names a task too.
    """
    for task in tasks:
        if module := module_of(task):
            check_trusted(module, f"task {task!r}")


def _uid(words: object, module: str) -> str:
    """Under which name it is noted that these words chose this module."""
    return sha256(json.dumps([words, module]).encode()).hexdigest()[:32]
