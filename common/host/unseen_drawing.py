"""Drawing of simulators without a display: each graphics library has a variable of its own that says how."""

import ctypes
import os
import sys
from functools import lru_cache
from importlib.util import find_spec

MUJOCO, OPENGL, PYGLET = "MUJOCO_GL", "PYOPENGL_PLATFORM", "PYGLET_HEADLESS"
MODULES = {MUJOCO: "mujoco", OPENGL: "OpenGL", PYGLET: "pyglet"}  # that heed these variables
CHOSEN = "DREAMFLEET_DRAWS_BY"  # what this or a parent process chose
LIBRARIES = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}  # in the order in which they are tried


def draw_unseen() -> None:
    """Let simulators of this process and its children open no window, and draw where there is no display."""
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    draw_offscreen()


@lru_cache(maxsize=1)
def draw_offscreen() -> None:
    """Let MuJoCo, PyOpenGL and pyglet draw into memory where there is no display and the user chose nothing.

    By EGL, or else by OSMesa. It counts for this process and its children, if it comes before a simulator is imported.
    """
    if sys.platform != "linux" or os.environ.get("DISPLAY"):
        return
    here = [name for name, module in MODULES.items() if find_spec(module) is not None]
    users = os.environ.get(MUJOCO) or os.environ.get(OPENGL)  # they count: docs/reference/tasks.md
    chosen = users or next((name for name, library in LIBRARIES.items() if here and _is_here(library)), "")
    values = {MUJOCO: chosen, OPENGL: chosen, PYGLET: "1" if chosen == "egl" else ""}
    for name in here:
        if chosen in LIBRARIES and values[name] and not os.environ.get(name):
            os.environ[name] = values[name]
            os.environ[CHOSEN] = chosen


def describe_choice() -> str:
    """A line about how this process draws, if `draw_unseen` chose it and MuJoCo is loaded; else empty."""
    chosen = os.environ.get(CHOSEN, "")
    if not chosen or "mujoco" not in sys.modules:
        return ""
    return f"drawn without a display: {MUJOCO}={chosen}; set {MUJOCO} or DISPLAY for another way"


def _is_here(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
