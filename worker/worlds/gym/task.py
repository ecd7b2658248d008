"""Any gymnasium environment as a task without a world model: the controller acts on the flat observation.

The task's name is `gym:` and the environment's id, for example `gym:LunarLander-v3`, or, with a package that must be
imported first, `gym:my_package:MyWorld-v0`. `with_options` makes of it the task of its pictures, for world models.
Pages: watch.md, export.md.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Actions, Discrete
from dreamfleet.common.artifacts.task_options import check_options
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.tasks import GYM
from dreamfleet.common.schema.validation import OPTIONAL, from_plain_lenient
from dreamfleet.worker.tasks.api import Assignment, Description, Policy, Task, World
from dreamfleet.worker.tasks.closing import close_environment, closing_environment
from dreamfleet.worker.tasks.model_free_policies import FlatPolicy
from dreamfleet.worker.tasks.reset import reset_folded
from dreamfleet.worker.worlds.gym import environments
from dreamfleet.worker.worlds.gym.pixels import GymPixelTask, PixelOptions
from dreamfleet.worker.worlds.gym.spaces import flatten_environment, is_of_numbers

OPTIONS = ("environment", "observation", "normalise", "seed")
NORMALISING_EPISODES = 20


@dataclass(frozen=True)
class Normalisation:
    """The mean and deviation of each observed number."""

    mean: tuple[float, ...]
    deviation: tuple[float, ...]


@dataclass(frozen=True)
class FlatOptions:
    """The options of `GymTask.describe`, and in the place of the last two what a run freezes of them."""

    environment: dict[str, Any] = field(default_factory=dict, metadata=OPTIONAL)
    observation: tuple[str, ...] = field(default=(), metadata=OPTIONAL)
    normal: Normalisation | None = field(default=None, metadata=OPTIONAL)
    normalise: bool = field(default=False, metadata=OPTIONAL)
    seed: int = field(default=0, metadata=OPTIONAL)

    @classmethod
    def parse(cls, text: str) -> FlatOptions:
        """Of a JSON object; an empty text has the defaults. `UsageError` for a wrong one."""
        try:
            return from_plain_lenient(cls, json.loads(text or "{}"))
        except (ValueError, RecursionError) as error:
            raise UsageError(f"{text!r:.200} are not options of a gymnasium environment: {error}") from error


class GymTask(Task):
    """The task `gym:ENVIRONMENT`: observations of numbers, flattened; numbered actions, or ones between bounds.

    >>> GymTask("LunarLander-v3").describe({}).observations
    8
    """

    def __init__(self, environment: str) -> None:
        self.name = f"{GYM}:{environment}"
        self._id = environment

    def with_options(self, options: str) -> GymPixelTask:
        """The task of the environment's pictures under options that `parse_options` writes; `UsageError` for others."""
        return GymPixelTask.of(self._id, options)

    def parse_options(self, arguments: Mapping[str, Any]) -> str:
        """Canonical JSON of the arguments that `PixelOptions` has and that differ from its defaults; empty for none."""
        return PixelOptions.of(arguments).text

    def world_of(self, assignment: Assignment) -> World:
        """The world of the environment's spaces and registration; `UsageError` if they cannot be used."""
        return self._facts(*_frozen(assignment)).world

    def make_environment(self, assignment: Assignment, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The environment, with the arguments that the run froze.

        `UsageError` if it has no render modes and pictures are wanted.
        """
        return self._open(*_frozen(assignment), render_mode)

    make_evaluation_environment = make_environment

    def make_watched_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any] | None:
        """The environment with pictures; `None` outside of gymnasium, where `render` might change scores."""
        if not self._facts(*_frozen(assignment)).is_drawn:
            return None
        return _RenderOnDemand(self.make_environment(assignment, environments.RGB))

    def make_policy(self, assignment: Assignment) -> Policy:
        """A controller on the flat observation, normalised with the statistics that the run froze."""
        actions, normal = self.world_of(assignment).actions, FlatOptions.parse(assignment.spec.options).normal
        if normal is None:
            return FlatPolicy(assignment.controller, actions)
        return FlatPolicy(assignment.controller, actions, normal.mean, normal.deviation)

    def find_standalone_script(self, assignment: Assignment) -> Path | None:
        """The script for Discrete and flat Box actions; `None` for other actions, which it would have to convert.

        So it is where a part of the observation is left out.
        """
        is_plain = self._facts(*_frozen(assignment)).is_plain
        return Path(__file__).with_name("standalone_play.py") if is_plain else None

    def describe(self, options: Mapping[str, Any]) -> Description:
        """Sizes, packages, and the options that a run freezes.

        Option `environment`: arguments of `gymnasium.make`. Option `observation`: keys of a Dict that are seen. Option
        `normalise`: shift and scale observations by their mean and standard deviation in 20 episodes of random actions,
        with seeds from `seed` on.
        """
        check_options(f"task {self.name}", options, OPTIONS)
        given = FlatOptions.parse(json.dumps({key: value for key, value in options.items() if value is not None}))
        arguments, keys = given.environment, list(dict.fromkeys(given.observation))
        with closing_environment(self._open(arguments, keys)) as environment:
            world = self._facts(arguments, keys).world
            self._check_version(environment)
            frozen: dict[str, Any] = {"environment": arguments} if arguments else {}
            if keys:
                frozen["observation"] = keys
            if given.normalise:
                mean, deviation = _measure_normalisation(environment, given.seed)
                frozen["normal"] = {"mean": mean.tolist(), "deviation": deviation.tolist()}
            observations = int(np.prod(environment.observation_space.shape or (1,)))
            steps = (environment.spec and environment.spec.max_episode_steps) or 0
        text = json.dumps(frozen, sort_keys=True) if frozen else ""
        return Description(observations, world.actions.outputs, world.packages, world.version, text, steps)

    def _check_version(self, environment: gymnasium.Env[Any, Any]) -> None:
        """`UsageError` for a name without a version: gymnasium takes its newest, and a later gymnasium another one."""
        module, colon, name = self._id.rpartition(":")
        found = "" if environment.spec is None else environment.spec.id
        if re.fullmatch(rf"{re.escape(name)}-v\d+", found, re.ASCII):
            raise UsageError(f"task {self.name} names no version: write {GYM}:{module}{colon}{found}")

    def _facts(self, arguments: Mapping[str, Any], keys: Sequence[str]) -> _Facts:
        """What is known of the environment; it is made only if this process never made it with these arguments."""
        key = self._key(arguments, keys)
        if key not in _known:
            close_environment(self._open(arguments, keys))
        return _known[key]

    def _open(
        self, arguments: Mapping[str, Any], keys: Sequence[str] = (), render_mode: str | None = None
    ) -> gymnasium.Env[Any, Any]:
        """The environment for a controller without a world model; its facts are known from then on."""
        made = environments.make_environment(self._id, arguments, render_mode)
        try:
            environment, actions = flatten_environment(made, self._id, keys)
            _known[self._key(arguments, keys)] = _Facts.of(made, actions, keys)
        except BaseException:
            close_environment(made)
            raise
        return environment

    def _key(self, arguments: Mapping[str, Any], keys: Sequence[str]) -> str:
        return f"{self._id} {json.dumps([arguments, list(keys)], sort_keys=True, default=repr)}"


@dataclass(frozen=True)
class _Facts:
    """What an environment says of itself: asked of one that is open, as many simulators allow one a process."""

    world: World
    is_drawn: bool  # its `render` is gymnasium's own, and gives pictures
    is_plain: bool  # it takes Discrete or a flat Box, and all that it observes is seen

    @classmethod
    def of(cls, made: gymnasium.Env[Any, Any], actions: Actions, keys: Sequence[str]) -> _Facts:
        """The facts of an environment before it was wrapped, and of its actions after that."""
        meanings, space = environments.action_meanings(made), made.action_space
        names = meanings if len(meanings) == actions.outputs and isinstance(actions, Discrete) else ()
        takes_plain = isinstance(space, spaces.Discrete) or (isinstance(space, spaces.Box) and len(space.shape) == 1)
        return cls(
            World(actions, action_names=names, **environments.describe_environment(made)),
            environments.is_gymnasiums(made) and environments.RGB in made.metadata.get("render_modes", ()),
            takes_plain and not keys and is_of_numbers(made.observation_space),
        )


_known: dict[str, _Facts] = {}  # of each environment and its arguments that this process made


def _frozen(assignment: Assignment) -> tuple[dict[str, Any], list[str]]:
    """The environment's arguments and the observation's keys that a run froze."""
    found = FlatOptions.parse(assignment.spec.options)
    return found.environment, list(found.observation)


class _RenderOnDemand(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Sets the render mode only while `render` draws, so that steps do no work for pictures.

    LunarLander, for example, creates a body for each engine spark if a render mode is set, and only `render` removes
    them. With ten pictures a second its steps would take many times as long.
    """

    def __init__(self, environment: gymnasium.Env[Any, Any]) -> None:
        super().__init__(environment)
        self.unwrapped.render_mode = None

    def render(self) -> Any:
        """Draw the current picture."""
        self.unwrapped.render_mode = environments.RGB
        try:
            return super().render()
        finally:
            self.unwrapped.render_mode = None


def _measure_normalisation(
    environment: gymnasium.Env[Any, Any], seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation `(observations,)` over episodes of random actions; 1 for a constant observation."""
    environment.action_space.seed(seed)
    seen = []
    for episode in range(NORMALISING_EPISODES):
        observation = reset_folded(environment, seed + episode)
        over, steps = False, 0
        while not over and steps < environments.DEFAULT_MAX_STEPS:
            steps += 1
            seen.append(np.asarray(observation, dtype=np.float64).reshape(-1))
            observation, _, terminated, truncated, _ = environment.step(environment.action_space.sample())
            over = terminated or truncated
    values = np.stack(seen)
    deviation = values.std(axis=0)
    return values.mean(axis=0), np.where(deviation > 1e-6, deviation, 1.0)
