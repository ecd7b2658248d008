"""Small tasks that score in microseconds or on command, for tests of everything around them."""

import hashlib
import os
import signal
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium import spaces

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.tasks.api import Continuous, Score, Task, World

MODULE = "tests.support.tasks"
NAMES = """Toy SlowToy Raising Crashing Nan Hanging Silent Judged Counted Heavy Chatty Painted Rounded SecondToy Brittle
Exploding Masked Veiled HalfMasked"""
(
    TOY, SLOW_TOY, RAISING, CRASHING, NAN, HANGING, SILENT, JUDGED, COUNTED, HEAVY, CHATTY, PAINTED, ROUNDED,
    SECOND_TOY, BRITTLE, EXPLODING, MASKED, VEILED,
    HALF_MASKED,
) = (f"{MODULE}:{name}" for name in NAMES.split())  # fmt: skip
ALL = TOY, SLOW_TOY, RAISING, CRASHING, NAN, HANGING, SILENT, JUDGED, COUNTED, HEAVY, PAINTED
STEPS_FOLDER = "DREAMFLEET_TEST_STEPS"  # where `Counted` writes
ROUNDING = "DREAMFLEET_TEST_ROUNDING"  # if set, `Rounded` computes as on another host class
ODD_REWARD = "DREAMFLEET_TEST_ODD_REWARD"  # a file: its number is the next episode's reward, which removes the file


class ToyEnvironment(gymnasium.Env):
    """Ten steps; the reward is the negative squared distance of the action to a target drawn from the seed."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(-1, 1, (8,))
    length = 10

    def __init__(self, seconds=0.0):
        self._seconds = seconds

    def look(self):
        return np.zeros(1, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._target = self.np_random.normal(0.5, 0.1, 8)
        self._left = self.length
        return self.look(), {}

    def step(self, action):
        if self._seconds:
            time.sleep(self._seconds)
        self._left -= 1
        reward = -float(((action - self._target) ** 2).sum())
        return self.look(), reward, self._left == 0, False, {}


class ToyPolicy:
    def begin(self, parameters):
        self._action = parameters[:8].astype(np.float64)

    def act(self, observation):
        return self._action


class Toy(Task):
    name = TOY
    world = World(Continuous.between([-1.0] * 8, [1.0] * 8))
    environment, policy, seconds = ToyEnvironment, ToyPolicy, 0.0

    def make_environment(self, assignment):
        return self.environment(self.seconds)

    def make_policy(self, assignment):
        return self.policy()


class SlowToy(Toy):
    """An episode takes about a third of a second."""

    seconds = 0.03


class Masked(Toy):
    """Each of the ten steps of an episode costs 1 without sight, and 2 with another's."""

    def make_masked_environment(self, assignment, *, foreign):
        cost = 2 if foreign else 1
        return gymnasium.wrappers.TransformReward(self.make_environment(assignment), lambda reward: reward - cost)


class FailingOn(gymnasium.Wrapper):
    def __init__(self, environment, seed):
        super().__init__(environment)
        self._seed = seed

    def reset(self, *, seed=None, options=None):
        if seed == self._seed:
            raise ArithmeticError("the road is dark")
        return super().reset(seed=seed, options=options)


class Veiled(Masked):
    """Without sight seed 10001 fails, with another's 10002."""

    def make_masked_environment(self, assignment, *, foreign):
        masked = super().make_masked_environment(assignment, foreign=foreign)
        return FailingOn(masked, 10_002 if foreign else 10_001)


class HalfMasked(Masked):
    """It has no other's sight."""

    def make_masked_environment(self, assignment, *, foreign):
        if foreign:
            raise UsageError("there is no other episode")
        return super().make_masked_environment(assignment, foreign=foreign)


class SecondToy(Toy):
    """An episode takes a second."""

    seconds = 0.1


class Rounded(Toy):
    """Rewards differ in the last bit between hosts."""

    def make_environment(self, assignment):
        made = super().make_environment(assignment)
        odd = np.finfo(np.float64).eps if ROUNDING in os.environ else 0.0
        return gymnasium.wrappers.TransformReward(made, lambda reward: reward * (1 - odd))


class BrittleEnvironment(ToyEnvironment):
    def reset(self, *, seed=None, options=None):
        self._is_barred = seed is not None and seed % 20 == 1
        return super().reset(seed=seed, options=options)

    def step(self, action):
        word = hashlib.sha256(action.tobytes() + self._target.tobytes()).digest()[0]
        if self._left == 7 and (self._is_barred or word < 26):
            raise ArithmeticError(f"the world of {id(self)} is brittle")
        return super().step(action)


class Brittle(Toy):
    """A tenth of the episodes raises by parameters and seed; one seed in 20 raises for all parameters."""

    environment = BrittleEnvironment


class Misbehaving(Toy):
    """Its controllers call `misbehave` before each action."""

    def make_policy(self, assignment):
        return MisbehavingPolicy(self.misbehave)


class MisbehavingPolicy(ToyPolicy):
    def __init__(self, misbehave):
        self._misbehave = misbehave

    def act(self, observation):
        self._misbehave()
        return super().act(observation)


class Raising(Misbehaving):
    def misbehave(self):
        raise RuntimeError("the road has ended")


class Crashing(Misbehaving):
    probe_steps = 0

    def misbehave(self):
        os.kill(os.getpid(), signal.SIGSEGV)


class Hanging(Misbehaving):
    probe_steps = 0

    def misbehave(self):
        time.sleep(3600)


class Silent(Misbehaving):
    """Closes every connection of its process, and runs on."""

    probe_steps = 0

    def misbehave(self):
        os.closerange(3, 1024)
        time.sleep(3600)


class Chatty(Misbehaving):
    """Prints more than a pipe holds, on both streams."""

    def misbehave(self):
        for stream in (sys.stdout, sys.stderr):
            print("look, " * 10_000, file=stream, flush=True)


class ToyPolicies:
    def begin(self, parameters):
        self._actions = parameters[:, :8].astype(np.float64)

    def act(self, observations):
        return self._actions

    def reward(self, values):
        pass

    def keep(self, rows):
        self._actions = self._actions[rows]


class SideBySidePolicy(ToyPolicy):
    def side_by_side(self):
        return ToyPolicies()


class SideBySide(Toy):
    """A slot drives up to four episodes at once."""

    batch_size, policy = 4, SideBySidePolicy


class OneByOne(Toy):
    """A slot takes one job after the other, whatever `batch_size` says: the policy is for one episode."""

    batch_size = 4


class NanPolicy(ToyPolicy):
    def begin(self, parameters):
        self._action = np.full(8, np.nan)


class Nan(Toy):
    policy = NanPolicy


class Judged(Toy):
    """Has a judge that differs from its environment."""

    def make_evaluation_environment(self, assignment):
        return gymnasium.wrappers.TransformReward(self.make_environment(assignment), lambda reward: reward + 100)


class Counted(Toy):
    """Counts the steps of all processes in a file; rewards depend on the bundle.

    A test can request an odd reward for one episode.
    """

    probe_steps = 0
    seconds = 0.001

    def make_environment(self, assignment):
        return CountedEnvironment(self.seconds, _reward_offset(assignment.bundle))


class Wide(Counted):
    """A slot scores 256 episodes at once."""

    batch_size = 256
    seconds = 0.0

    def make_batch(self, assignment):
        return WideBatch(self.make_environment(assignment))


class WideBatch:
    def __init__(self, environment):
        self._environment = environment

    def score(self, episodes, on_step):
        scores = []
        for vector, seed in episodes:
            self._environment.reset(seed=int(seed))
            action = vector[:8].astype(np.float64)
            fitness = sum(self._environment.step(action)[1] for _ in range(10))
            scores.append(Score(float(fitness), 10))
            on_step(10 * len(scores))
        return scores


def _reward_offset(bundle):
    """A number that depends on the verified content of the bundle."""
    return 0.0 if bundle is None else hashlib.sha256(bundle.read("encoder.onnx")).digest()[0] / 2560


def _odd_reward():
    """The requested odd reward; only one process gets it."""
    asked = Path(os.environ.get(ODD_REWARD, "/nowhere"))
    taken = asked.with_name(f"{asked.name}.{os.getpid()}")
    try:
        asked.rename(taken)
    except OSError:
        return None
    return float(taken.read_text())


class CountedEnvironment(ToyEnvironment):
    def __init__(self, seconds, shift=0.0):
        super().__init__(seconds)
        self._shift, self._odd = shift, None
        file = (Path(os.environ[STEPS_FOLDER]) / f"{os.getpid()}-{time.monotonic_ns()}").open("w+b")
        file.write(bytes(8))
        file.flush()
        self._made = np.memmap(file, np.uint64, "r+", shape=(1,))

    def reset(self, *, seed=None, options=None):
        made = super().reset(seed=seed)
        self._target += self._shift
        self._odd = _odd_reward()
        return made

    def step(self, action):
        self._made[0] += 1
        seen, reward, *rest = super().step(action)
        return seen, reward if self._odd is None else self._odd, *rest


class HeavyEnvironment(ToyEnvironment):
    observation_space = spaces.Box(0, 255, (100_000,), np.uint8)

    def look(self):
        return self.np_random.integers(0, 256, 100_000, np.uint8)


class Heavy(Toy):
    """Observations do not compress: a kept drive takes a megabyte."""

    environment = HeavyEnvironment


class FlatBatch:
    """Each episode has this fitness and so many steps."""

    def __init__(self, fitness, steps):
        self._score = Score(fitness, steps)

    def score(self, episodes, on_step):
        on_step(self._score.steps)
        return [self._score] * len(episodes)


class OnTorch(Toy):
    """A slot scores 256 episodes at once, and 8 on a torch device; each is worth 1."""

    batch_size, torch_batch_size = 256, 8

    def make_batch(self, assignment):
        return FlatBatch(1.0, 1)


class Exploding(Toy):
    """A slot scores episodes together; rewards are finite, but their mean overflows."""

    def make_batch(self, assignment):
        return FlatBatch(1.7e308, 10)


class PaintedEnvironment(ToyEnvironment):
    observation_space, length = spaces.Box(0, 255, (16, 24, 3), np.uint8), 50

    def look(self):
        return np.full((16, 24, 3), (self.length - self._left) % 256, np.uint8)


class Painted(Toy):
    """Observes pictures whose colour is the step number; an episode has 50 slow steps."""

    environment, seconds = PaintedEnvironment, 0.02


def steps_made(folder):
    return sum(int.from_bytes(path.read_bytes(), "little") for path in Path(folder).iterdir())
