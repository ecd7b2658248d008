"""gym:tests.support.strict_environments:Strict-v0: an environment that refuses each action outside of its space."""

import gymnasium
import numpy as np
from gymnasium import spaces

STRICT = "tests.support.strict_environments:Strict-v0"
ACTIONS = {
    "float64": spaces.Box(-0.1, 0.1, (2,), np.float64),  # float32(0.1) > 0.1
    "float32": spaces.Box(-0.1, 0.1, (2,), np.float32),
    "float16": spaces.Box(-0.1, 0.7, (2,), np.float16),
    "square": spaces.Box(-0.1, 0.1, (2, 1), np.float64),
    "bytes": spaces.Box(0, 255, (2,), np.uint8),
    "signed": spaces.Box(np.array([-3, 0]), np.array([3, 10**9]), dtype=np.int64),
    "mixed": spaces.Dict({"turn": spaces.Box(-0.3, 0.3, (1,), np.float64), "gear": spaces.Box(1, 6, (1,), np.int8)}),
    "start": spaces.Discrete(3, start=-7),
    "many": spaces.MultiDiscrete([11, 11, 11]),
    "large": spaces.Discrete(4096, start=1),
    "endless": spaces.Box(np.iinfo(np.int64).min, np.iinfo(np.int64).max, (1,), np.int64),
}


class Strict(gymnasium.Env):
    """Its argument `actions` names its action space; `breaks` is an action that it has, but cannot take."""

    observation_space = spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self, actions="float64", breaks=None, huge=False):
        self.action_space, self.breaks, self.huge = ACTIONS[actions], breaks, huge

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([1e39 if self.huge else 0.5]), {}

    def step(self, action):
        assert action in self.action_space
        if self.breaks is not None and np.all(action == self.breaks):
            raise RuntimeError("too much")
        return np.array([1e39 if self.huge else 0.5]), 1.0, False, False, {"taken": action}


gymnasium.register("Strict-v0", Strict, max_episode_steps=20)
