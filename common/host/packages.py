"""The packages of this distribution and its extras, and the command that installs them."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

# distribution -> (module, extra); the empty extra is required by every role
PACKAGES = {
    "eclipse-zenoh": ("zenoh", ""),
    "msgpack": ("msgpack", ""),
    "numpy": ("numpy", ""),
    "cma": ("cma", ""),
    "gymnasium": ("gymnasium", "worker"),
    "pygame-ce": ("pygame", "worker"),
    "box2d": ("Box2D", "worker"),
    "onnxruntime": ("onnxruntime", "worker"),
    "vizdoom": ("vizdoom", "doom"),
    "av": ("av", "views"),
    "matplotlib": ("matplotlib", "views"),
    "torch": ("torch", "train"),
    "onnx": ("onnx", "train"),
    "safetensors": ("safetensors", "train"),
    "plotly": ("plotly", "dashboard"),
    "starlette": ("starlette", "dashboard"),
    "uvicorn": ("uvicorn", "dashboard"),
    "pyarrow": ("pyarrow", "export"),
    "tensorboardX": ("tensorboardX", "export"),
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


def package_version(name: str) -> str | None:
    """Installed version of a distribution, or `None`."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None
