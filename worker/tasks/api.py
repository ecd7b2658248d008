"""The contract of a task: an environment, the policy that acts in it, and what the rest of the system knows of it.

A package with a task needs only this module; docs/reference/tasks.md has an example. The dream, the real track and any
gymnasium environment satisfy the same contract. What a task may have beyond it has a file each: `batches.py`,
`side_by_side.py`, `recordable.py`, `true_state.py`. Pages: determinism.md, protocol.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Actions, Continuous, Discrete, Mirror, one_hot
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import Description
from dreamfleet.worker.tasks.model_free_policies import Driver, FlatPolicy
from dreamfleet.worker.tasks.world import ENVIRONMENT_LIMIT, DreamReward, World

__all__ = [
    "ENVIRONMENT_LIMIT", "Actions", "Assignment", "Continuous", "Description", "Discrete", "DreamReward", "Driver",
    "Mirror", "Policy", "Score", "Task", "World", "one_hot",
]  # fmt: skip


@dataclass(frozen=True)
class Assignment:
    """What is scored: a run's specification and, for tasks that need one, its world model.

    >>> from dreamfleet import find_bundle
    >>> assignment = Assignment.of("car-racing", find_bundle("tiny"))
    >>> assignment.spec.task, assignment.controller.size
    ('car-racing', 867)
    """

    spec: TaskSpec
    bundle: Bundle | None = None
    torch_device: str = ""  # that batches may compute on, such as "cuda"; empty: the processor's core

    def __post_init__(self) -> None:
        """`BundleError` if the bundle is not the one that the specification names."""
        if self.bundle is not None and self.bundle.sha256 != self.spec.bundle:
            raise BundleError(
                f"{self.bundle.path} is the world model {self.bundle.sha256[:12]}..., and what is scored in is "
                f"{self.spec.bundle[:12]}...: put the right one there"
            )

    @classmethod
    def of(cls, task: str, bundle: Bundle) -> Assignment:
        """A task with a world model, outside of any run."""
        return cls(TaskSpec(task, bundle.sha256, ENVIRONMENT_LIMIT, 0), bundle)

    @property
    def world_model(self) -> Bundle:
        """The bundle for the run's controllers, which drive by its options; `BundleError` if there is no bundle."""
        spec = self.spec
        if self.bundle is None:
            raise BundleError(f"task {spec.task} needs a world model: give one with --bundle")
        own = spec.controller or spec.options
        return self.bundle.with_options(spec.controller, spec.options) if own else self.bundle

    @property
    def controller(self) -> ControllerShape:
        """The shape of the controllers that are scored."""
        return self.spec.controller or self.world_model.controller_shape


class Policy(Protocol):
    """Turns observations into actions, with the parameters of one controller.

    It may also have `reward(value)`, which gets the reward of each action before the next `act`. If its actions hide
    the numbers they come from, such as the index of the largest output, it may have `outputs(observation)`: these
    numbers, as one or more arrays. Their bits distinguish host classes too.

    >>> class Steady:
    ...     def begin(self, parameters):
    ...         self.action = parameters[:3]
    ...     def act(self, observation):
    ...         return self.action
    >>> policy: Policy = Steady()
    >>> policy.begin(np.ones(3, np.float32))
    >>> policy.act(None)
    array([1., 1., 1.], dtype=float32)
    """

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Start an episode with a controller's flat parameter vector `(size,)`."""

    def act(self, observation: Any) -> Any:
        """The action for an observation, as the environment's `step` takes it."""


@dataclass(frozen=True)
class Score:
    """Result of an episode: its fitness, the number of environment steps, and the specification's measures.

    >>> Score(fitness=812.5, steps=1000).fitness
    812.5
    """

    fitness: float
    steps: int
    measures: tuple[float, ...] = ()


class Task:
    """Base class of tasks.

    A subclass defines `name`, `world` and `make_environment`. Without a world model it also defines
    `describe(options)`, which returns the `Description` that a new run freezes, or raises `UsageError` for an unknown
    option. The default policy is a linear or hidden controller on the flat observation.
    An incomplete task is refused when it is looked up, with a list of what is missing.

    >>> import gymnasium
    >>> from dreamfleet import Description, Discrete, Task, World
    >>> class Balance(Task):
    ...     name = "balance"
    ...     world = World(Discrete(2))
    ...     def make_environment(self, assignment):
    ...         return gymnasium.make("CartPole-v1")
    ...     def describe(self, options):
    ...         return Description(observations=4, outputs=self.world.actions.outputs)
    >>> Balance().describe({}).outputs
    2
    """

    name: str
    batch_size: ClassVar[int] = 1  # episodes that a slot scores at once
    torch_batch_size: ClassVar[int] = 0  # the same on a torch device, for tasks whose batches use one; 0: they do not
    # Steps of a short episode with a fixed seed and fixed parameters, by which a worker determines its host class
    # before it scores anything. 0: there is no such episode, and the host's fingerprint determines the class.
    probe_steps: ClassVar[int] = 16
    world: World

    def world_of(self, assignment: Assignment) -> World:  # noqa: ARG002 - other tasks' worlds depend on the assignment
        """The world that is scored in."""
        return self.world

    def reality(self, assignment: Assignment) -> Task:  # noqa: ARG002 - a dream's reality depends on its bundle
        """The task whose world evaluation episodes are driven in: this one, unless it is a dream."""
        return self

    def make_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any]:
        """A new environment that candidates are scored in; the policy takes its observations."""
        raise NotImplementedError

    def make_evaluation_environment(
        self, assignment: Assignment, render_mode: str | None = None
    ) -> gymnasium.Env[Any, Any]:
        """A new environment that reported scores and videos come from; by default `make_environment`."""
        if render_mode is not None:
            raise UsageError(
                f"task {self.name} draws no pictures: its make_evaluation_environment takes no render_mode"
            )
        return self.make_environment(assignment)

    def make_watched_environment(
        self,
        assignment: Assignment,  # noqa: ARG002 - subclasses use it
    ) -> gymnasium.Env[Any, Any] | None:
        """A new environment that candidates are scored in while somebody watches, for tasks that observe no pictures.

        It must give the same scores to the bit; its `render` gives pictures and changes nothing else. `None`: there is
        none, and observations are shown if they are pictures.
        """
        return None

    def find_standalone_script(self, assignment: Assignment) -> Path | None:  # noqa: ARG002 - subclasses use it
        """A script that acts by the files beside it, without dreamfleet (`dreamfleet card`); `None`: there is none.

        With a world model these are `controller.onnx`, of one step; without one, `controller.npz`.
        """
        return None

    def make_policy(self, assignment: Assignment) -> Policy:
        """A new policy; `BundleError` if the bundle belongs to another task."""
        return FlatPolicy(assignment.controller, self.world_of(assignment).actions)
