"""The packages of this distribution and its extras, and the command that installs them. Pages: README.md."""

import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.abc import MetaPathFinder
from importlib.metadata import PackageNotFoundError, distributions, packages_distributions, requires, version
from importlib.util import find_spec
from threading import get_ident

GYMNASIUM = "gymnasium"
# distribution -> (module, extra); the empty extra is required by every role
PACKAGES = {
    "eclipse-zenoh": ("zenoh", ""),
    "msgpack": ("msgpack", ""),
    "msgspec": ("msgspec", ""),
    "numpy": ("numpy", ""),
    "cma": ("cma", ""),
    "cmaes": ("cmaes", ""),
    "prometheus-client": ("prometheus_client", ""),
    "rich": ("rich", ""),
    "psutil": ("psutil", ""),
    GYMNASIUM: ("gymnasium", "worker"),
    "pygame-ce": ("pygame", "worker"),
    "box2d": ("Box2D", "worker"),
    "onnxruntime": ("onnxruntime", "worker"),
    "vizdoom": ("vizdoom", "doom"),
    "cryptography": ("cryptography", "access"),
    "av": ("av", "views"),
    "matplotlib": ("matplotlib", "views"),
    "torch": ("torch", "train"),
    "safetensors": ("safetensors", "train"),
    "plotly": ("plotly", "dashboard"),
    "starlette": ("starlette", "dashboard"),
    "uvicorn": ("uvicorn", "dashboard"),
    "ribs": ("ribs", "qd"),
    "numba": ("numba", "qd"),
    "pyarrow": ("pyarrow", "export"),
    "tensorboardX": ("tensorboardX", "export"),
    "onnx": ("onnx", "export"),  # and training
}


def install_command(extra: str) -> str:
    """The command that installs an extra; an empty extra is the distribution alone."""
    return f"pip install 'dreamfleet[{extra}]'" if extra else "pip install dreamfleet"


def extra_of(module: str | None) -> str | None:
    """The extra that contains a module; `None` if none does."""
    top = (module or "").partition(".")[0]
    return next((extra for each, extra in PACKAGES.values() if each == top), None)


def install_command_for(module: str | None) -> str | None:
    """The command that installs a missing module; `None` if no extra contains it."""
    extra = extra_of(module)
    return None if extra is None else install_command(extra)


def check_modules(names: Iterable[str]) -> None:
    """`ModuleNotFoundError` for the first of these modules that is missing: now rather than after hours."""
    for name in names:
        if find_spec(name) is None:
            raise ModuleNotFoundError(name=name)


@cache
def package_version(name: str) -> str | None:
    """Installed version of a distribution, or `None`; as this process found it first, whatever is installed later."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def wanted_versions(name: str) -> str:
    """The versions of a distribution that this one requires, such as `gymnasium<1.5,>=1.4`; empty for any."""
    own = (each.partition(";")[0].strip() for each in requires("dreamfleet") or ())
    return next((each for each in own if re.fullmatch(rf"{re.escape(name)}[<>=].*", each)), "")


def wrong_version(name: str) -> str:
    """The remedy if a distribution is here in a version that this one does not work with; else empty.

    Packages of environments bring such versions: pip replaces what is installed by what they ask for.
    """
    found, wanted = package_version(name), wanted_versions(name)
    bounds = re.findall(r"(<|>=)([\d.]+)", wanted)
    if found is None or all((_parts(found) < _parts(bound)) == (sign == "<") for sign, bound in bounds):
        return ""
    return (
        f"{name} {found} is installed, and this needs {wanted}: another package brought it. Run `pip install "
        f"'{wanted}'`, and install that package by `pip install --no-deps` (docs/reference/tasks.md)"
    )


def _parts(number: str) -> tuple[int, ...]:
    """A version's numbers, without trailing zeros, so that 2.0 is 2."""
    parts = [int(each) for each in re.findall(r"\d+", re.match(r"[\d.]*", number)[0])]  # type: ignore[index]
    while parts and not parts[-1]:
        parts.pop()
    return tuple(parts)


@cache
def find_distributions(module: str) -> tuple[str, ...]:
    """The installed distributions that have a module; empty for a module of no distribution."""
    top = module.partition(".")[0]
    if not any(_may_have(top, each.read_text) for each in distributions()):
        return ()  # a user's own module, as most: the full answer reads every installed file's name
    return tuple(packages_distributions().get(top, ()))


def _may_have(top: str, read: Callable[[str], str | None]) -> bool:
    """Whether a distribution whose metadata `read` reads may have a top-level module."""
    if declared := read("top_level.txt"):
        return top in declared.split()
    if files := read("RECORD"):
        lines = f"\n{files}"
        return f"\n{top}/" in lines or f"\n{top}." in lines
    return any(top in (read(name) or "") for name in ("installed-files.txt", "SOURCES.txt"))


def allow_swig_types() -> None:
    """Ignore warnings of native modules made by SWIG, such as Box2D, whose import they would else end (SIGSEGV)."""
    warnings.filterwarnings("ignore", r"builtin type [sS]wig\w* has no __module__", DeprecationWarning)


@contextmanager
def hidden(*modules: str) -> Iterator[None]:
    """Let this thread's optional imports of these modules fail, which saves seconds; loaded ones stay visible."""
    finder = _Hiding(frozenset(modules), get_ident())
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


@dataclass(frozen=True)
class _Hiding(MetaPathFinder):
    """Finds nothing, and says that these modules are missing."""

    modules: frozenset[str]
    thread: int

    def find_spec(self, fullname: str, _path: object, _target: object = None) -> None:
        if fullname in self.modules and get_ident() == self.thread:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)
