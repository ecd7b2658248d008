"""Any gymnasium environment as a task without a world model: the controller acts on the flat observation.

The task's name is `gym:` and the environment's id, for example `gym:LunarLander-v3`, or, with a package that must be
imported first, `gym:my_package:MyWorld-v0`.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Mapping
from importlib.metadata import packages_distributions
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Actions, Continuous, Discrete
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.trusted_modules import check_trusted
from dreamfleet.common.protocol.tasks import GYM
from dreamfleet.worker.tasks.api import ENVIRONMENT_LIMIT, Assignment, Description, Policy, Task, World
from dreamfleet.worker.tasks.policy import FlatPolicy
from dreamfleet.worker.tasks.reset import reset_folded

RGB = "rgb_array"  # gymnasium's render mode that returns pictures
_MODULE_PREFIX = re.compile(r"([\w.]+):")  # of an environment's name
OPTIONS = ("environment", "normalise", "seed")
NORMALISING_EPISODES = 20
DEFAULT_MAX_STEPS = 10_000  # steps of an episode, if the environment was registered without a limit
# Packages that gymnasium's own environments compute with. Other environments: the distribution of their module.
ENGINES = {
    "gymnasium.envs.box2d": ("box2d", "box2d-py"),
    "gymnasium.envs.mujoco": ("mujoco",),
    "gymnasium.envs.classic_control": (),
    "gymnasium.envs.toy_text": (),
}


class GymTask(Task):
    """The task `gym:ENVIRONMENT`; Box observations of any shape, Box or Discrete actions."""

    def __init__(self, environment: str) -> None:
        self.name = f"{GYM}:{environment}"
        self._id = environment

    def world_of(self, assignment: Assignment) -> World:
        """The world of the environment's spaces and registration; `UsageError` if they cannot be used."""
        environment = self.make_environment(assignment)
        try:
            return _build_world(environment, self._id)
        finally:
            environment.close()

    def make_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any]:
        """The environment, with the arguments that the run froze."""
        return self._make(assignment.spec.option("environment", {}))

    def make_evaluation_environment(
        self, assignment: Assignment, render_mode: str | None = None
    ) -> gymnasium.Env[Any, Any]:
        """The same environment; `UsageError` if it has no render modes and pictures are wanted."""
        arguments = dict(assignment.spec.option("environment", {}))
        if render_mode is None:
            return self._make(arguments)
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", ".*render_mode")  # gymnasium's: the error says it
                return self._make({**arguments, "render_mode": render_mode})
        except UsageError as error:
            if not isinstance(error.__cause__, TypeError):
                raise
            self._make(arguments).close()  # without pictures it is sound
            raise UsageError(
                f"this environment ({self._id}) draws no pictures: it must take `render_mode`, and its `render` must "
                f"return an array (height, width, 3) in the render mode {render_mode}"
            ) from error

    def make_watched_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any] | None:
        """The environment with pictures; `None` outside of gymnasium, where `render` might change scores."""
        plain = self.make_environment(assignment)
        plain.close()
        own = type(plain.unwrapped).__module__.startswith(tuple(ENGINES))
        drawn = own and RGB in plain.metadata.get("render_modes", ())
        return _RenderOnDemand(self.make_evaluation_environment(assignment, RGB)) if drawn else None

    def make_policy(self, assignment: Assignment) -> Policy:
        """A controller on the flat observation, normalised with the statistics that the run froze."""
        normal = assignment.spec.option("normal", {"mean": 0.0, "deviation": 1.0})
        return FlatPolicy(assignment.controller, self.world_of(assignment).actions, normal["mean"], normal["deviation"])

    def describe(self, options: Mapping[str, Any]) -> Description:
        """Sizes, packages, and the options that a run freezes.

        Option `environment`: arguments of `gymnasium.make`. Option `normalise`: shift and scale observations by their
        mean and standard deviation in 20 episodes of random actions, with seeds from `seed` on.
        """
        if unknown := set(options) - set(OPTIONS):
            raise UsageError(f"task {self.name} knows no option {', '.join(sorted(unknown))}: {', '.join(OPTIONS)}")
        arguments = dict(options.get("environment") or {})
        environment = self._make(arguments)
        try:
            world = _build_world(environment, self._id)
            frozen: dict[str, Any] = {"environment": arguments} if arguments else {}
            if options.get("normalise"):
                mean, deviation = _measure_normalisation(environment, int(options.get("seed", 0)))
                frozen["normal"] = {"mean": mean.tolist(), "deviation": deviation.tolist()}
            observations = int(np.prod(environment.observation_space.shape or (1,)))
        finally:
            environment.close()
        text = json.dumps(frozen, sort_keys=True) if frozen else ""
        return Description(observations, world.actions.outputs, world.packages, world.version, text)

    def _make(self, arguments: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
        _check_arguments(self.name, arguments)
        try:
            return gymnasium.make(self._id, disable_env_checker=True, **arguments)
        except gymnasium.error.DependencyNotInstalled as error:
            raise UsageError(f"{self._id} lacks a package on this host: {error}") from error
        except (gymnasium.error.Error, ModuleNotFoundError) as error:
            module, colon, _ = self._id.rpartition(":")
            remedy = "" if colon else f"; an environment of another package is written {GYM}:its_module:Its-v0"
            if colon and isinstance(error, ModuleNotFoundError):
                remedy = f"; install the package of {module} on this host, or name its folder in PYTHONPATH"
            raise UsageError(f"gymnasium makes no environment {self._id!r} here ({error}){remedy}") from error
        except TypeError as error:
            raise UsageError(f"{self._id} takes no such arguments: {error}") from error
        except (Exception, SystemExit) as error:  # environments may raise anything
            raise UsageError(f"{self._id} cannot be made: {type(error).__name__}: {error}") from error


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
        self.unwrapped.render_mode = RGB
        try:
            return super().render()
        finally:
            self.unwrapped.render_mode = None


def _check_arguments(task: str, arguments: Any) -> None:
    """`UsageError` for an argument `module:Environment` of an untrusted module: some environments make others."""
    if isinstance(arguments, str) and (found := _MODULE_PREFIX.match(arguments)):
        check_trusted(found[1], f"argument {arguments!r:.100} of task {task!r}")
    if isinstance(arguments, Mapping):
        arguments = list(arguments.values())
    if isinstance(arguments, list):
        for each in arguments:
            _check_arguments(task, each)


def _build_world(environment: gymnasium.Env[Any, Any], name: str) -> World:
    observations = environment.observation_space
    if not isinstance(observations, spaces.Box):
        raise UsageError(f"{name} observes {observations}: only Box observations can be flattened for a controller")
    module = str(environment.unwrapped.__class__.__module__)
    engine = next((packages for prefix, packages in ENGINES.items() if module.startswith(prefix)), None)
    if engine is None:
        engine = tuple(sorted(set(packages_distributions().get(module.partition(".")[0], ()))))
    rate = environment.metadata.get("render_fps") or World.frames_per_second
    return World(
        actions=_convert_action_space(environment.action_space, name),
        packages=("numpy", "gymnasium", *engine),
        horizon=ENVIRONMENT_LIMIT if _has_step_limit(environment) else DEFAULT_MAX_STEPS,
        frames_per_second=max(1, round(rate)),
        threshold=environment.spec.reward_threshold if environment.spec else None,
    )


def _has_step_limit(environment: gymnasium.Env[Any, Any]) -> bool:
    return environment.spec is not None and bool(environment.spec.max_episode_steps)


def _convert_action_space(space: Any, name: str) -> Actions:
    if isinstance(space, spaces.Discrete):
        return Discrete(int(space.n), int(space.start))
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and space.shape[0]:
        if not np.issubdtype(space.dtype, np.floating):
            raise UsageError(
                f"{name} takes whole numbers as actions: wrap it so that they are Discrete, or of a float Box"
            )
        if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            raise UsageError(f"{name} takes actions without bounds: wrap it so that its actions have a range")
        return Continuous.between(space.low, space.high)
    raise UsageError(f"{name} takes actions {space}: a controller gives a Discrete action or a flat Box")


def _measure_normalisation(
    environment: gymnasium.Env[Any, Any], seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation `(observations,)` over episodes of random actions; 1 for a constant observation."""
    environment.action_space.seed(seed)
    seen = []
    for episode in range(NORMALISING_EPISODES):
        observation = reset_folded(environment, seed + episode)
        over, steps = False, 0
        while not over and steps < DEFAULT_MAX_STEPS:
            steps += 1
            seen.append(np.asarray(observation, dtype=np.float64).reshape(-1))
            observation, _, terminated, truncated, _ = environment.step(environment.action_space.sample())
            over = terminated or truncated
    values = np.stack(seen)
    deviation = values.std(axis=0)
    return values.mean(axis=0), np.where(deviation > 1e-6, deviation, 1.0)
