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


for each in (Dark, Blank, Raising):
    gymnasium.register(f"{each.__name__}-v0", entry_point=each)
