"""The packages of this distribution and its extras, and the command that installs them."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

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


def install_command_for(module: str | None) -> str | None:
    """The command that installs a missing module; `None` if no extra contains it."""
    top = (module or "").partition(".")[0]
    return next((install_command(extra) for each, extra in PACKAGES.values() if each == top), None)


def package_version(name: str) -> str | None:
    """Installed version of a distribution, or `None`."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None
