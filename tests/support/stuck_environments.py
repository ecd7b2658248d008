"""Environments whose `close` never ends, or whose constructors raise."""

import os
import threading
from pathlib import Path
from typing import ClassVar

import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

MODULE = "tests.support.stuck_environments"


class StuckClose(CartPoleEnv):
    """Counts the calls of `close`, which wait for ever, also in a file."""

    calls: ClassVar = []

    def __init__(self, file=os.devnull, render_mode=None):
        super().__init__(render_mode=render_mode)
        self.file = file

    def close(self):
        self.calls.append(self)
        with Path(self.file).open("a") as file:
            file.write("closed\n")
        threading.Event().wait()


class Mistaken(CartPoleEnv):
    """Raises a TypeError of its own."""

    def __init__(self, size=None, render_mode=None):
        super().__init__(render_mode=render_mode)
        if size is not None:
            int([size])


class HandsOn(Mistaken):
    def __init__(self, **arguments):
        super().__init__(**arguments)


for each in (StuckClose, Mistaken, HandsOn):
    gymnasium.register(f"{each.__name__}-v0", each, max_episode_steps=20)
gymnasium.register("Lazy-v0", "tests.support.needy_environments:Needy")
