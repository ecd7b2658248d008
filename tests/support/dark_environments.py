"""Environments of gymnasium that cannot be filmed."""

import gymnasium
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
            raise ZeroDivisionError("no road")
        return super().step(action)


for each in (Dark, Blank, Raising, Plain, Breaking):
    gymnasium.register(f"{each.__name__}-v0", entry_point=each)
