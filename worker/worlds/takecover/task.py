"""Take Cover as a task. This module needs no vizdoom, so that every worker can name the task."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous, Mirror, one_hot
from dreamfleet.worker.tasks.api import Assignment, Description, DreamReward, Driver, Policy, Task, World
from dreamfleet.worker.tasks.drivers import HeldActions, UniformActions
from dreamfleet.worker.tasks.model_free_policies import DriverPolicy, FlatPolicy
from dreamfleet.worker.tasks.pictures import CropAndResize, VectorActions
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.tasks.registry import preprocessing_for
from dreamfleet.worker.worldmodel.policy import ModelPolicy
from dreamfleet.worker.worlds.bilinear import shrink
from dreamfleet.worker.worlds.takecover.game import BAND, FAR_TURNS, LEFT, RIGHT, STAY, TakeCover, observe_band
from dreamfleet.worker.worlds.takecover.masking import MaskedTakeCover
from dreamfleet.worker.worlds.takecover.options import TakeCoverOptions

PACKAGES = ("numpy", "onnxruntime", "vizdoom")
SOLVED = 750.0  # tics, the mean of 100 episodes: OpenAI Gym's DoomTakeCover-v0
CHOICES, THIRDS = one_hot(3), Continuous.between([-1], [1])
AGENTS = TakeCoverOptions(tics=1)  # of trained agents, which decide at every tic or hold a choice themselves
# Of the game's whole picture, rows 10 to 109 are what is above the status bar on its screen.
WME = TakeCoverOptions(tics=1, actions="thirds", crop="10:110,0:160")
WHOLE = Preprocessing("screen-96", 96, partial(shrink, size=96), mirrors=False)  # named in worker/addons/importing/


def cut_in_thirds(action: NDArray[np.float32]) -> int:
    """The game's action for a number `(1,)` from -1 to 1: left below -1/3, right above 1/3.

    >>> [cut_in_thirds(np.array([number], np.float32)) for number in (-1, 0, 1)]
    [1, 0, 2]
    """
    if 3 * action[0] < -1:
        return LEFT
    return RIGHT if 3 * action[0] > 1 else STAY


def pick_choice(action: NDArray[np.float32]) -> int:
    """The game's action for a one-hot row `(3,)`: stay, left, right."""
    return int(np.argmax(action))


def actions_of(options: TakeCoverOptions) -> Continuous:
    """Three outputs, of which the largest is done, or one that is cut in thirds."""
    return CHOICES if options.actions == "choices" else THIRDS


def make_world(options: TakeCoverOptions) -> World:
    """The world under these options."""
    actions = actions_of(options)
    return World(
        actions=actions,
        packages=PACKAGES,
        horizon=options.horizon,
        frames_per_second=options.frames_per_second,
        action_names=("stay", "left", "right") if actions.choices else ("aside",),
        dream_reward=DreamReward(gain=float(options.tics), source="survival"),
        threshold=SOLVED,
        score_word="game",
        marks=(SOLVED,),
        figures=(FAR_TURNS,),
        mirror=Mirror((0, 2, 1), (1, 1, 1)) if actions.choices else Mirror((0,), (-1,)),
        preset="takecover",
    )


class TakeCoverTask(Task):
    """The task `takecover`: on a world model's latent state, or without one on the brightness of a band of pixels."""

    name = "takecover"
    world = make_world(TakeCoverOptions())
    wme_options = WME.text  # read by worker/addons/importing/
    agent_world, agent_options = make_world(AGENTS), AGENTS.text
    agent_pictures: Mapping[str, Preprocessing] = {WHOLE.name: WHOLE}

    def __init__(self, options: TakeCoverOptions | None = None) -> None:
        self._options = options or TakeCoverOptions()
        self.world = make_world(self._options)
        actions = actions_of(self._options)
        self.drivers: Mapping[str, Callable[[np.random.Generator], Driver]] = {
            "held": lambda random: HeldActions(random, actions)  # the article's
        }
        self.policies: Mapping[str, Callable[[np.random.Generator], Policy]] = {
            "uniform": lambda random: DriverPolicy(UniformActions(random, actions))
        }
        self.preprocessings: Mapping[str, Preprocessing] = self._options.preprocessings

    def with_options(self, options: str) -> TakeCoverTask:
        """The same task under the options in a JSON object; `UsageError` for unknown ones."""
        return TakeCoverTask(TakeCoverOptions.parse(options))

    def parse_options(self, arguments: Mapping[str, Any]) -> str:
        """The canonical text of options as flags give them; `UsageError` for unknown ones."""
        return TakeCoverOptions.of(arguments).text

    def describe(self, options: Mapping[str, Any]) -> Description:
        """Sizes, packages and options of a run without a world model, whose controllers see a band of pixels."""
        text = self.parse_options(options)
        world = self.with_options(text).world
        return Description(BAND, world.actions.outputs, world.packages, world.version, text, world.horizon)

    def world_of(self, assignment: Assignment) -> World:
        """The world under the options of the world model, or of a run without one."""
        return self._bound_to(assignment).world

    def make_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any]:
        """The game in the world model's pictures, or without a world model as a band of pixels."""
        task = self._bound_to(assignment)
        return task._observed(task._make_game(), assignment)

    def make_masked_environment(self, assignment: Assignment, *, foreign: bool) -> gymnasium.Env[Any, Any]:
        """The same without fireballs in its pictures, or with those of another game."""
        task = self._bound_to(assignment)
        return task._observed(MaskedTakeCover(task._make_game(), task._make_game() if foreign else None), assignment)

    def make_recorded(self, preprocessing: str) -> gymnasium.Env[Any, Any]:
        """The game in the preprocessing of this name."""
        return self._recorded(self._make_game(), preprocessing)

    def make_evaluation_environment(
        self, assignment: Assignment, render_mode: str | None = None  # noqa: ARG002 - the game always draws
    ) -> gymnasium.Env[Any, Any]:  # fmt: skip
        """The same: a score is in tics of the game, and to draw it costs nothing."""
        return self.make_environment(assignment)

    def make_agent_environment(
        self, preprocessing: str, render_mode: str | None = None  # noqa: ARG002 - the game always draws
    ) -> gymnasium.Env[Any, Any]:  # fmt: skip
        """The same game as a trained agent sees it: the whole screen in the preprocessing of this name."""
        return self._seen_by_agent(TakeCover(AGENTS.tics, screen=True), preprocessing)

    def make_masked_agent_environment(self, preprocessing: str, *, foreign: bool) -> gymnasium.Env[Any, Any]:
        """That without fireballs on its screen, or with those of another game."""
        game, other = (TakeCover(AGENTS.tics, screen=True, labelled=True) for _ in range(2))
        return self._seen_by_agent(MaskedTakeCover(game, other if foreign else None), preprocessing)

    def make_watched_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any]:
        """Another of the same, whose `render` gives the game's own picture."""
        return self.make_environment(assignment)

    def make_policy(self, assignment: Assignment) -> Policy:
        """A controller on a world model's latent state, or on the band; `BundleError` for other pictures."""
        task = self._bound_to(assignment)
        if assignment.bundle is None:
            return FlatPolicy(assignment.controller, task.world.actions)
        preprocessing_for(assignment.bundle, task)
        return ModelPolicy(assignment.world_model)

    def _bound_to(self, assignment: Assignment) -> TakeCoverTask:
        """The task under the options of the world model, or of a run without one."""
        if assignment.bundle is None:
            return self.with_options(assignment.spec.options)
        manifest = assignment.bundle.manifest
        return self if manifest.task != self.name else self.with_options(manifest.world.options)

    def _observed(self, game: gymnasium.Env[Any, Any], assignment: Assignment) -> gymnasium.Env[Any, Any]:
        if assignment.bundle is None:
            band = spaces.Box(0, 1, (BAND,), np.float32)
            return self._with_actions(TransformObservation(game, observe_band, band))
        return self._recorded(game, preprocessing_for(assignment.bundle, self).name)

    def _seen_by_agent(self, game: gymnasium.Env[Any, Any], preprocessing: str) -> gymnasium.Env[Any, Any]:
        seen = self.agent_pictures[preprocessing]
        space = spaces.Box(0, 255, seen.shape, np.uint8)
        return VectorActions(TransformObservation(game, seen.picture, space), CHOICES, pick_choice)

    def _recorded(self, game: gymnasium.Env[Any, Any], preprocessing: str) -> gymnasium.Env[Any, Any]:
        return self._with_actions(CropAndResize(game, self.preprocessings[preprocessing].size, self._options.part))

    def _make_game(self) -> TakeCover:
        return TakeCover(self._options.tics)

    def _with_actions(self, environment: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
        actions = actions_of(self._options)
        return VectorActions(environment, actions, pick_choice if actions.choices else cut_in_thirds)
