"""Agents, which are evaluated, recorded and watched: a controller with its world model, or a trained agent without.

Pages: trust.md.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.addons.evaluation_report import Sight
from dreamfleet.common.addons.own_modules import trust_own_run
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.addons.evaluation.known_score import KnownScore, find_known_score
from dreamfleet.worker.scoring.scorer import find_checked_world
from dreamfleet.worker.tasks.api import ENVIRONMENT_LIMIT, Assignment, Policy, Task, World
from dreamfleet.worker.tasks.registry import find_scored_task
from dreamfleet.worker.tasks.true_state import TaskWithTrueState, Truth
from dreamfleet.worker.worlds.network_agent import NetworkAgent
from dreamfleet.worker.worlds.trained_agent import TrainedAgent

Floats = NDArray[np.float32]
Policies = Callable[[int], Policy]
"""A function from an episode's seed to its policy; the caller calls `begin`."""


class Agent(Protocol):
    """Drives whole episodes in the world that it is evaluated in. It can be pickled for other processes."""

    @property
    def sha256(self) -> str:
        """Hash of everything that its actions depend on, except world model, observation and seed."""

    @property
    def task(self) -> str:
        """Name of the task that it was evolved or trained in."""

    @property
    def options(self) -> str:
        """The options of that task, as a run freezes them."""

    @property
    def bundle(self) -> Bundle | None:
        """Its world model, if it has one."""

    @property
    def parameters(self) -> Floats:
        """The parameters `(size,)` for its policy's `begin`."""

    @property
    def world(self) -> World:
        """The world of its task."""

    @property
    def reality(self) -> str:
        """Name of the task of the world that it is evaluated in; after a dream, another than `task`."""

    @property
    def known_score(self) -> KnownScore | None:
        """Its mean score, where it was measured before."""

    def make_evaluation_environment(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The environment that reported scores and videos come from."""

    def make_policies(self) -> Policies:
        """Load its policy once, for one episode after another."""

    @property
    def truth(self) -> Truth | None:
        """A function that reads the true state behind the last observation; `None` if the task has none."""


@runtime_checkable
class TaskWithMask(Protocol):  # docs/reference/worlds.md
    """Optional: a task whose evaluation environment has a twin with changed pictures and the same episodes.

    A controller that looks loses by either change; one that moves by habit loses by neither.
    """

    def make_masked_environment(self, assignment: Assignment, *, foreign: bool) -> gymnasium.Env[Any, Any]:
        """The environment with what decides painted out; if `foreign`, with another episode's in its place."""


def make_agent(controller: Controller | TrainedAgent, bundle: Bundle | None = None) -> Agent:
    """The agent of a controller, with its world model if it has one, or of a trained agent's file.

    `ControllerError`, `BundleError` or `UsageError` if it does not fit the tasks and packages of this host.
    """
    if isinstance(controller, TrainedAgent):
        return NetworkAgent(controller)
    trust_own_run(controller.provenance.get("run_uid"), controller.task, controller.options)
    fitting = None if bundle is None else bundle.for_controller(controller)
    agent = EvolvedAgent(
        controller.sha256, make_evaluation_spec(controller, bundle), controller.parameters, fitting,
        find_known_score(controller),
    )  # fmt: skip
    find_checked_world(agent.assignment)
    return agent


def make_evaluation_spec(controller: Controller, bundle: Bundle | None) -> TaskSpec:
    """The specification of a controller's evaluation: whole episodes of its task."""
    return TaskSpec(
        controller.task, bundle.sha256 if bundle else "", horizon=ENVIRONMENT_LIMIT, patience=0,
        controller=controller.shape, options=controller.options, version=controller.version,
    )  # fmt: skip


@dataclass(frozen=True)
class EvolvedAgent:
    """The agent of a controller that a run evolved."""

    sha256: str
    spec: TaskSpec
    parameters: Floats = field(repr=False)
    bundle: Bundle | None = None  # of the controller's shape and variant
    known_score: KnownScore | None = None
    sight: Sight | None = None  # what it sees of what decides: nothing, or another episode's; `None`: that itself

    @property
    def assignment(self) -> Assignment:
        """What it is evaluated in, in the form that tasks take."""
        return Assignment(self.spec, self.bundle)

    @property
    def task(self) -> str:
        """Name of the task that it was evolved in."""
        return self.spec.task

    @property
    def options(self) -> str:
        """The options of that task."""
        return self.spec.options

    @property
    def world(self) -> World:
        """The world of its task."""
        return self._task.world_of(self.assignment)

    @property
    def reality(self) -> str:
        """Name of the task that it is evaluated in."""
        return self._reality.name

    def make_evaluation_environment(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """Its task's evaluation environment; a task without pictures may have no parameter `render_mode`."""
        task, given = self._task, () if render_mode is None else (render_mode,)
        if self.sight is not None and isinstance(reality := self._reality, TaskWithMask):
            return reality.make_masked_environment(self.assignment, foreign=self.sight == "foreign")
        return task.make_evaluation_environment(self.assignment, *given)

    @property
    def has_mask(self) -> bool:
        """Whether the task that it is evaluated in can hide what decides."""
        return isinstance(self._reality, TaskWithMask)

    def make_policies(self) -> Policies:
        """Its task's policy, the same one in each episode."""
        policy = self._task.make_policy(self.assignment)
        return lambda _seed: policy

    @property
    def truth(self) -> Truth | None:
        """That of the task that it is evaluated in."""
        reality = self._reality
        return reality.truth if isinstance(reality, TaskWithTrueState) else None

    @property
    def _task(self) -> Task:
        return find_scored_task(self.task, self.bundle)

    @property
    def _reality(self) -> Task:
        return self._task.reality(self.assignment)


def masked(agent: Agent, sight: Sight) -> Agent:
    """The same agent with this sight; `UsageError` if nothing hides in its world what decides."""
    if isinstance(agent, EvolvedAgent | NetworkAgent) and agent.has_mask:
        return replace(agent, sight=sight)
    raise UsageError(f"{agent.reality} has no mask over its pictures, which --blind needs")
