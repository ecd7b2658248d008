"""Where a run's curves are written while it goes on: the setting `log_to`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from typing import NamedTuple

from dreamfleet.common.errors import UsageError

MODULES = {"tensorboard": "tensorboardX", "wandb": "wandb", "mlflow": "mlflow"}
INSTALL = {"tensorboardX": "'dreamfleet[export]'"}  # what pip installs, where that is not the module's name


class SinkName(NamedTuple):
    """A kind of record, and its folder, project or address; empty: the default one."""

    kind: str
    where: str


def parse_sink(text: str) -> SinkName:
    """KIND or KIND:WHERE; `UsageError` for another kind.

    >>> parse_sink("mlflow:http://127.0.0.1:5000")
    SinkName(kind='mlflow', where='http://127.0.0.1:5000')
    """
    kind, _, where = text.partition(":")
    if kind not in MODULES:
        raise UsageError(f"log_to {text!r}: name one of {', '.join(MODULES)}, or one with :WHERE behind it")
    return SinkName(kind, where)


def parse_sinks(texts: Sequence[str]) -> tuple[SinkName, ...]:
    """All of them; `UsageError` also if a kind is named twice."""
    found = tuple(map(parse_sink, texts))
    if len({each.kind for each in found}) < len(found):
        raise UsageError(f"log_to names a kind twice: {', '.join(texts)}")
    return found


def check_sinks(texts: Iterable[str]) -> None:
    """`UsageError` if a package is not installed on this host."""
    for text in texts:
        module = MODULES[parse_sink(text).kind]
        if not _is_installed(module):
            raise UsageError(
                f"log_to {text!r} needs the package {module!r}, which is not installed: "
                f"pip install {INSTALL.get(module, module)}"
            )


def _is_installed(module: str) -> bool:
    with suppress(ModuleNotFoundError):
        spec = find_spec(module)
        return spec is not None and spec.origin is not None  # a folder of this name is no package
    return False
