"""Environments of which a process can hold one at a time, as of many simulators; both observe numbers and draw."""

from typing import ClassVar

import gymnasium
import numpy as np

MODULE = "tests.support.single_environments"


class Single(gymnasium.Env):
    """Refuses a second instance while one is open."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    is_open = False

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.begin()

    def begin(self):
        if Single.is_open:
            raise RuntimeError("another one is open")
        Single.is_open = True

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.at, {}

    def step(self, action):
        self.at = np.clip(self.at + 0.1 * action, -1, 1).astype(np.float32)
        return self.at, 1 - float(np.abs(self.at).sum()), False, False, {}

    def render(self):
        return np.full((16, 16, 3), 128, np.uint8)

    def close(self):
        Single.is_open = False


class Shared(Single):
    """Its `close` shuts what all instances share."""

    def begin(self):
        Shared.is_on = True

    def step(self, action):
        if not Shared.is_on:
            raise RuntimeError("the simulator is off")
        return super().step(action)

    def close(self):
        Shared.is_on = False


for each in (Single, Shared):
    gymnasium.register(f"{each.__name__}-v0", each, max_episode_steps=20)
