import os
import re
import sys

import gymnasium
import pytest

from dreamfleet.common.host import unseen_drawing
from dreamfleet.common.host.unseen_drawing import describe_choice, draw_offscreen
from dreamfleet.worker.worlds.gym.environments import make_environment

VARIABLES = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "PYGLET_HEADLESS")


@pytest.fixture
def host(monkeypatch, tmp_path):
    """A host with MuJoCo, PyOpenGL and pyglet, and without a display; it returns which libraries are there."""
    for name in (*VARIABLES, unseen_drawing.CHOSEN, "DISPLAY"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    for module in ("mujoco", "OpenGL", "pyglet"):
        monkeypatch.delitem(sys.modules, module, raising=False)
        (tmp_path / f"{module}.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    here = {"libEGL.so.1", "libOSMesa.so.8"}
    monkeypatch.setattr(unseen_drawing, "_is_here", lambda library: library in here)
    monkeypatch.setattr(sys, "platform", "linux")
    draw_offscreen.cache_clear()
    yield here
    draw_offscreen.cache_clear()


def chosen():
    draw_offscreen()
    return tuple(os.environ.get(name) for name in VARIABLES)


@pytest.mark.parametrize(
    ("missing", "variables", "found"),
    [
        ((), {}, ("egl", "egl", "1")),
        (("libEGL.so.1",), {}, ("osmesa", "osmesa", None)),
        (("libEGL.so.1", "libOSMesa.so.8"), {}, (None, None, None)),
        ((), {"DISPLAY": ":0"}, (None, None, None)),
        ((), {"MUJOCO_GL": "osmesa"}, ("osmesa", "osmesa", None)),
        ((), {"MUJOCO_GL": "glfw"}, ("glfw", None, None)),
        ((), {"PYOPENGL_PLATFORM": "osmesa"}, ("osmesa", "osmesa", None)),
    ],
)
def test_the_users_choice_draws_else_egl_else_osmesa(host, monkeypatch, missing, variables, found):
    host.difference_update(missing)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert chosen() == found
    assert not describe_choice()
    monkeypatch.setitem(sys.modules, "mujoco", os)
    assert bool(re.search("MUJOCO_GL.*egl", describe_choice())) == (found[0] == "egl")


def test_a_host_without_these_packages_keeps_its_variables(host, monkeypatch):
    monkeypatch.setattr(unseen_drawing, "find_spec", lambda _name: None)
    assert chosen() == (None, None, None)


class Arm(gymnasium.Env):
    """Reports by what it would draw."""

    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def __init__(self):
        self.drawn_by = os.environ.get("MUJOCO_GL")


def test_an_environment_is_made_where_it_can_draw(host):
    with make_environment(f"{__name__}:Arm", {}) as made:
        assert made.unwrapped.drawn_by == "egl"
