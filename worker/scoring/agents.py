"""Who is judged, recorded and watched: a controller with its world model, or what drives without one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.trained_agent import TrainedAgent
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.car_racing.agents import NetworkAgent
from dreamfleet.worker.scoring.scorer import find_checked_world
from dreamfleet.worker.tasks.api import ENVIRONMENT_LIMIT, Assignment, Policy, Task, TaskWithTrueState, World
from dreamfleet.worker.tasks.registry import find_task

Floats = NDArray[np.float32]
Policies = Callable[[int], Policy]
"""The policy of the episode of a seed, which `begin` is still to begin."""
Truth = Callable[[gymnasium.Env[Any, Any]], dict[str, float]]


class Agent(Protocol):
    """Drives whole episodes of one world, whatever it is; it goes to other processes."""

    @property
    def sha256(self) -> str:
        """Of all that its choices follow from, but world model, observation and the episode's seed."""

    @property
    def task(self) -> str:
        """That it was evolved or trained in."""

    @property
    def bundle(self) -> Bundle | None:
        """Its world model; `None`: it has none."""

    @property
    def parameters(self) -> Floats:
        """What its policy begins each episode with."""

    @property
    def world(self) -> World:
        """In which it drives."""

    @property
    def reality(self) -> str:
        """Name of the task of the world that it is judged in."""

    @property
    def threshold(self) -> float | None:
        """Mean score at which gymnasium has that world for solved; `None`: it says none."""

    def make_judge(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The environment that reported scores and videos come from."""

    def make_policies(self) -> Policies:
        """It at the wheel: loaded once, for episodes one after the other."""

    @property
    def truth(self) -> Truth | None:
        """Tells the true state behind the last observation; `None` in a world that keeps it to itself."""


def make_agent(controller: Controller | TrainedAgent, bundle: Bundle | None = None) -> Agent:
    """A controller, with its world model if it has one, or a trained agent, ready to drive.

    Errors of either kind, where it does not fit what is here, say what to do.
    """
    if isinstance(controller, TrainedAgent):
        return NetworkAgent(controller)
    fitting = None if bundle is None else bundle.for_controller(controller)
    agent = EvolvedAgent(controller.sha256, make_evaluation_spec(controller, bundle), controller.parameters, fitting)
    find_checked_world(agent.assignment)
    return agent


def make_evaluation_spec(controller: Controller, bundle: Bundle | None) -> TaskSpec:
    """What a controller is judged in: whole episodes of its own task."""
    return TaskSpec(
        controller.task, bundle.sha256 if bundle else "", horizon=ENVIRONMENT_LIMIT, patience=0,
        controller=controller.shape, options=controller.options, version=controller.version,
    )  # fmt: skip


@dataclass(frozen=True)
class EvolvedAgent:
    """A controller's parameters in what it is judged in."""

    sha256: str
    spec: TaskSpec
    parameters: Floats = field(repr=False)
    bundle: Bundle | None = None  # under its shape and variant

    @property
    def assignment(self) -> Assignment:
        """What it is judged in, as tasks ask for it."""
        return Assignment(self.spec, self.bundle)

    @property
    def task(self) -> str:
        """That it was evolved in."""
        return self.spec.task

    @property
    def world(self) -> World:
        """As its task has it."""
        return self._task.world_of(self.assignment)

    @property
    def reality(self) -> str:
        """Of one from a dream another task."""
        return self._reality.name

    @property
    def threshold(self) -> float | None:
        """Of that world."""
        return self._reality.world_of(self.assignment).threshold

    def make_judge(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """Its task's judge; one that draws nothing need not know of a mode."""
        task, given = self._task, () if render_mode is None else (render_mode,)
        return task.make_judge(self.assignment, *given)

    def make_policies(self) -> Policies:
        """Its task's policy, the same in each episode."""
        policy = self._task.make_policy(self.assignment)
        return lambda _seed: policy

    @property
    def truth(self) -> Truth | None:
        """As that world tells it."""
        reality = self._reality
        return reality.truth if isinstance(reality, TaskWithTrueState) else None

    @property
    def _task(self) -> Task:
        return find_task(self.task)

    @property
    def _reality(self) -> Task:
        return self._task.reality(self.assignment)
