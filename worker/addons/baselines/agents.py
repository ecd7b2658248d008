"""Agents without a world model: random drivers, and the network in its training's folder. Pages: own-environment.md."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import FIVE_CHOICES, STEERING_GAS_BRAKE, Actions, Discrete, one_hot
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.errors import MissingExtraError, UsageError
from dreamfleet.common.files.regular_files import is_file
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import describe_task
from dreamfleet.worker.addons.baselines.presets import CHECKPOINT
from dreamfleet.worker.addons.evaluation.agents import Agent, EvolvedAgent
from dreamfleet.worker.addons.evaluation.named_agents import DISCRETE, RANDOM
from dreamfleet.worker.tasks.api import ENVIRONMENT_LIMIT, World
from dreamfleet.worker.tasks.drivers import UniformActions
from dreamfleet.worker.tasks.model_free_policies import NO_PARAMETERS
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.tasks.true_state import Truth
from dreamfleet.worker.worlds.car_racing.preprocessing import RAW
from dreamfleet.worker.worlds.car_racing.task import WORLD, CarRacingTask
from dreamfleet.worker.worlds.network_agent import NetworkAgent

Floats = NDArray[np.float32]
ACTIONS_KEY = (3,)  # of the seed's child that random actions come from


class RandomPolicy:
    """Draws each action uniformly: one of its choices, or a number between the bounds of each component.

    >>> RandomPolicy(np.random.default_rng(1), Discrete(3, first=5)).act(None)
    np.int64(6)
    """

    def __init__(self, random: np.random.Generator, actions: Actions) -> None:
        self._driver = UniformActions(random, one_hot(actions.outputs) if isinstance(actions, Discrete) else actions)
        self._convert: Callable[[Floats], Any] = actions.to_action if isinstance(actions, Discrete) else np.asarray

    def begin(self, parameters: Floats) -> None:
        """Do nothing: it has no memory."""

    def act(self, _observation: Any) -> Any:
        """Return an action as the environment's `step` takes it."""
        return self._convert(self._driver.act())


@dataclass(frozen=True)
class CarRacingRandomAgent:
    """One of CarRacing's two random drivers; the episode's seed is its random seed."""

    task: ClassVar[str] = CarRacingTask.name
    reality: ClassVar[str] = CarRacingTask.name
    world: ClassVar[World] = WORLD
    options: ClassVar[str] = ""
    bundle: ClassVar[None] = None
    parameters: ClassVar[Floats] = NO_PARAMETERS
    known_score: ClassVar[None] = None

    name: str

    @property
    def sha256(self) -> str:
        """The SHA-256 of its name, hexadecimal."""
        return _hash(self.name)

    @property
    def truth(self) -> Truth:
        """The task's function from an environment to its true state."""
        return CarRacingTask().truth

    def make_evaluation_environment(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The environment that scores come from; it ignores pictures, so the raw ones do."""
        return CarRacingTask().make_agent_environment(RAW.name, render_mode)

    def make_policies(self) -> Callable[[int], RandomPolicy]:
        """Return a function from an episode's seed to a policy."""
        actions = FIVE_CHOICES if self.name == DISCRETE else STEERING_GAS_BRAKE
        return lambda seed: RandomPolicy(np.random.default_rng(seed), actions)


class UniformAgent(EvolvedAgent):
    """Uniform random actions in the world in which a run without a world model would judge its controllers."""

    def make_policies(self) -> Callable[[int], RandomPolicy]:
        """Return a function from an episode's seed to a policy.

        Environments draw from their seed as it is, so its actions come from a child of that seed.
        """
        actions = self.world.actions
        return lambda seed: RandomPolicy(np.random.default_rng(SeedSequence(seed, spawn_key=ACTIONS_KEY)), actions)


def make_random_agent(name: str, task: str | None, options: Mapping[str, Any]) -> Agent:
    """The random driver of this name in a task under its options, by default the first world.

    `UsageError` for a task that needs a world model.
    """
    task = task or FIRST_WORLD
    if task == FIRST_WORLD and not options:
        return CarRacingRandomAgent(name)
    if name == DISCRETE:
        raise UsageError(f"{DISCRETE} draws CarRacing's five actions: give --controller {RANDOM}")
    if not callable(getattr(find_task(task), "describe", None)):
        raise UsageError(
            f"{RANDOM} actions need a task that is played without a world model, and {task} is not: give "
            f"{FIRST_WORLD} without options, gym:ENVIRONMENT or module:Task"
        )
    about = describe_task(task, options)
    shape = ControllerShape(about.observations, about.outputs)
    spec = TaskSpec(task, "", ENVIRONMENT_LIMIT, 0, controller=shape, options=about.options, version=about.version)
    return UniformAgent(_hash(f"{name} {task} {about.options}"), spec, NO_PARAMETERS)


def find_network(folder: Path) -> Agent | None:
    """The agent that was trained in this folder, `None` if none was; `DatasetError` for a damaged checkpoint."""
    if not is_file(folder / CHECKPOINT):
        return None
    if find_spec("torch") is None:
        raise MissingExtraError(
            f"the training in {folder} needs torch, which is not installed: pip install 'dreamfleet[train]'; an agent "
            "that `dreamfleet baseline export` wrote needs no torch: `dreamfleet evaluate --controller FILE`"
        )
    from dreamfleet.worker.addons.baselines.export import export_agent

    return NetworkAgent(export_agent(folder))


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
