"""A gymnasium environment that fails as environments do: by its parameters and its seed, wherever it is scored."""

import os
import time

import gymnasium
import numpy as np
from gymnasium import spaces

PARTS = 2000  # of the unit interval that an episode's fate is drawn from


class WeekendEnvironment(gymnasium.Env):
    """Twenty steps towards a target; 2 % of the episodes give NaN, raise, crash after a fork, or hang."""

    observation_space = spaces.Box(-1, 1, (3,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._target = self.np_random.normal(0.3, 0.2, 2)
        self._fate = int(self.np_random.integers(PARTS))
        self._steps = 0
        return self._observe(), {}

    def step(self, action):
        self._steps += 1
        reward = -float(((action - self._target) ** 2).sum())
        if self._steps == 3:
            reward = self._fail(action, reward)
        return self._observe(), reward, self._steps >= 20, False, {}

    def _fail(self, action, reward):
        digits = int.from_bytes(np.asarray(action, np.float32).tobytes()[:2], "little")
        fate = (self._fate + digits) % PARTS
        if fate < 16:
            return float("nan")
        if fate < 28:
            raise ValueError(f"the simulator {self!r} at {id(self):#x} exploded")
        if fate < 38:
            if not os.fork():  # it lives on, and holds what its parent held
                time.sleep(60)
                os._exit(0)
            os._exit(3)
        if fate < 40:
            time.sleep(10_000)
        return reward

    def _observe(self):
        return self.np_random.uniform(-1, 1, 3).astype(np.float32)


gymnasium.register("Weekend-v0", "tests.support.weekend_world:WeekendEnvironment")
