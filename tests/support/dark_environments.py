"""Environments of gymnasium that cannot be filmed."""

import os
import time
from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv


class Dark(CartPoleEnv):
    """Has no `render` of its own."""

    render = gymnasium.Env.render


class Blank(CartPoleEnv):
    def render(self):
        return None


class Raising(CartPoleEnv):
    def render(self):
        raise ZeroDivisionError("no light")


class Plain(gymnasium.Env):
    """Knows nothing of render modes."""

    observation_space, action_space = CartPoleEnv().observation_space, CartPoleEnv().action_space

    def __init__(self):
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 1.0, False, False, {}


class Breaking(CartPoleEnv):
    """Draws pictures, and fails later."""

    steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps > 3:
            self.break_down()
        return super().step(action)

    @staticmethod
    def break_down():
        raise ZeroDivisionError("no road")


def interrupt():
    raise KeyboardInterrupt


LATER = {"Interrupting": interrupt, "Leaving": lambda: os._exit(3), "Stuck": lambda: time.sleep(600)}


class Slow(Plain):
    """Draws pictures, without end."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def step(self, action):
        time.sleep(0.02)
        return super().step(action)

    def render(self):
        return np.zeros((64, 64, 3), np.uint8)


for each in (
    *(Dark, Blank, Raising, Plain, Breaking, Slow),
    *(type(name, (Breaking,), {"break_down": staticmethod(how)}) for name, how in LATER.items()),
):
    gymnasium.register(f"{each.__name__}-v0", entry_point=each)
