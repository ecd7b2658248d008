"""A world of thirty lines in which a dot falls and the player must not be under it.

It is gymnasium's `tests.support.pixel_world:Dodge-v0`, and `DodgeTask` is a task in which data are recorded.
"""

from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from dreamfleet.worker.tasks.api import DreamReward, Mirror, Task, World, one_hot
from dreamfleet.worker.tasks.drivers import HeldActions, UniformActions
from dreamfleet.worker.tasks.pictures import CropAndResize, VectorActions, box_resize
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.worldmodel.policy import ModelPolicy

MODULE = "tests.support.pixel_world"
DODGE, DODGE_TASK = f"gym:{MODULE}:Dodge-v0", f"{MODULE}:DodgeTask"
HEIGHT, WIDTH, SIDE, SPEED = 48, 40, 6, 4  # pixels; the dot falls and the player moves this far in a step
STAY, LEFT, RIGHT = range(3)


class Dodge(gymnasium.Env):
    """A point for each step; the end of a dot's fall on the player is death, and its last picture is black."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space, action_space = spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8), spaces.Discrete(3)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._player, self._dead = (WIDTH - SIDE) // 2, False
        self._drop()
        return self.render(), {}

    def step(self, action):
        move = {STAY: 0, LEFT: -SPEED, RIGHT: SPEED}[int(action)]
        self._player = min(max(self._player + move, 0), WIDTH - SIDE)
        self._row += SPEED
        if self._row >= HEIGHT - SIDE:
            self._dead = abs(self._column - self._player) < SIDE
            self._drop()
        return self.render(), 1.0, self._dead, False, {}

    def _drop(self):
        aimed = self.np_random.random() < 0.5
        self._row, self._column = 0, self._player if aimed else int(self.np_random.integers(WIDTH - SIDE + 1))

    def render(self):
        picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        if not self._dead:
            picture[:], picture[HEIGHT - SIDE :, self._player : self._player + SIDE] = 40, (0, 200, 0)
            picture[self._row : self._row + SIDE, self._column : self._column + SIDE] = (255, 120, 0)
        return picture


gymnasium.register("Dodge-v0", Dodge, max_episode_steps=200)


ACTIONS = one_hot(3)


class DodgeTask(Task):
    """The world as a task that a world model is made of. It has neither beginnings nor a true state."""

    name = DODGE_TASK
    world = World(
        ACTIONS, ("numpy", "onnxruntime", "gymnasium"), horizon=200, frames_per_second=10,
        action_names=("stay", "left", "right"), dream_reward=DreamReward(gain=1.0, source="survival"), threshold=100.0,
        score_word="game", marks=(50, 100), mirror=Mirror((0, 2, 1), (1, 1, 1)),
    )  # fmt: skip
    preprocessings: ClassVar = {"box-64": Preprocessing("box-64", 64, lambda picture: box_resize(picture, 64))}
    drivers: ClassVar = {
        "held": lambda random: HeldActions(random, ACTIONS),
        "uniform": lambda random: UniformActions(random, ACTIONS),
    }

    def make_recorded(self, preprocessing, render_mode=None):
        environment = gymnasium.make(f"{MODULE}:Dodge-v0", render_mode=render_mode)
        pictures = CropAndResize(environment, self.preprocessings[preprocessing].size)
        return VectorActions(pictures, ACTIONS, np.argmax)

    def make_environment(self, assignment):
        return self.make_recorded("box-64")

    def make_evaluation_environment(self, assignment, render_mode=None):
        return self.make_recorded("box-64", render_mode)

    def make_policy(self, assignment):
        return ModelPolicy(assignment.world_model)
