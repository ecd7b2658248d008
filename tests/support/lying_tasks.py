"""A task on hosts that lie, or whose memory fails: the environment of their worker says which."""

import os
import time

import gymnasium
import numpy as np

from dreamfleet.common.host.stall_watch import STALL_SECONDS
from tests.support.tasks import Toy, ToyEnvironment, ToyPolicy

WATCHED = "tests.support.lying_tasks:Watched"
LIES = "DREAMFLEET_TEST_LIES"  # a share: so many of the episodes get another reward, by their seed and parameters
STAYS = "DREAMFLEET_TEST_STAYS"  # if set, no episode of a run ends before its worker is killed
FLIPS = "DREAMFLEET_TEST_FLIPS"  # a number: after so many episodes a bit of a slot's memory is flipped, for good


class Watched(Toy):
    """As `Toy`; every host has the same class, because the class is taken on a seed that no run uses."""

    name = WATCHED
    seconds = 0.005  # a step: no host scores the whole run before another joins

    def make_environment(self, assignment):
        if STAYS in os.environ:
            return StayingEnvironment(self.seconds)
        return LyingEnvironment(self.seconds) if LIES in os.environ else ToyEnvironment(self.seconds)

    def make_policy(self, assignment):
        return FlippingPolicy(int(os.environ[FLIPS])) if FLIPS in os.environ else ToyPolicy()


class LyingEnvironment(gymnasium.Wrapper):
    """Adds to the reward of some episodes."""

    def __init__(self, seconds):
        super().__init__(ToyEnvironment(seconds))
        self._share = float(os.environ[LIES])

    def reset(self, *, seed=None, options=None):
        self._seed = seed
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, ended, cut, info = super().step(action)
        drawn = np.frombuffer(action.tobytes(), np.uint32).sum(dtype=np.uint64) * np.uint64(2654435769) % 2**32
        lies = ended and self._seed and drawn < self._share * 2**32
        return observation, reward + lies, ended, cut, info


class StayingEnvironment(ToyEnvironment):
    """Takes the time of a hung job for its first step."""

    def reset(self, *, seed=None, options=None):
        self._stays = bool(seed)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        time.sleep(2 * STALL_SECONDS * self._stays)
        return super().step(action)


class FlippingPolicy(ToyPolicy):
    """Multiplies by ones that lie in memory, of which one loses a bit; the class is taken in ten episodes."""

    def __init__(self, episodes):
        self._left, self._ones = episodes, np.ones(8)

    def begin(self, parameters):
        super().begin(parameters)
        self._left -= 1
        if self._left == 0:
            self._ones.view(np.uint64)[3] ^= np.uint64(1 << 40)
        self._action = self._action * self._ones
