"""What a task is: an environment, what a controller sees of it and may do, and all that the rest must know of a world.

The only module that a third party imports; docs/tasks.md has an example. The dream, the real track and any gymnasium
environment satisfy the same contract, so that no caller can tell them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE, Actions, Continuous, Discrete
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import Description
from dreamfleet.worker.tasks.policy import Driver, FlatPolicy

__all__ = [
    "STEERING_GAS_BRAKE",
    "Actions",
    "Assignment",
    "Batch",
    "BatchedTask",
    "Continuous",
    "Description",
    "Discrete",
    "DreamReward",
    "Driver",
    "Episode",
    "Policy",
    "PolicyWithOutputs",
    "Preprocessing",
    "RecordableTask",
    "RewardAwarePolicy",
    "Score",
    "StepObserver",
    "StepSnapshot",
    "Task",
    "TaskWithPolicies",
    "TaskWithTrueState",
    "WatchableBatch",
    "World",
]

ENVIRONMENT_LIMIT = 10**6  # steps: the environment's own limit ends an episode


class Policy(Protocol):
    """What turns observations into actions, under one controller."""

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode with this controller's flat vector."""

    def act(self, observation: Any) -> Any:
        """The environment's next action."""


class RewardAwarePolicy(Protocol):
    """A policy that also wants to know what its actions bring; a policy need not."""

    def reward(self, value: float) -> None:
        """The reward of the last action, before the next one is asked for."""


class PolicyWithOutputs(Protocol):
    """A policy whose actions hide what it computed, such as an index of the largest output; a policy need not tell."""

    def outputs(self, observation: Any) -> Any:
        """What it makes an action of, as one or more arrays: by these bits too hosts are told apart."""


@dataclass(frozen=True)
class Score:
    """An episode's outcome: fitness, and environment steps made."""

    fitness: float
    steps: int


Episode = tuple[NDArray[np.float32], int]
"""A candidate's flat vector and the seed of its episode."""


class StepSnapshot(NamedTuple):
    """A step of an episode as whoever looks on is shown it, before its action is done."""

    step: int  # those that were made before it
    score: float  # what they brought
    action: NDArray[Any]  # that follows
    picture: NDArray[np.uint8] | None = None  # (height, width, 3), where one is seen
    latent: NDArray[np.float32] | None = None  # (latent,), of a world model
    state: NDArray[np.float32] | None = None  # (state,), what it remembers before the action


class StepObserver(Protocol):
    """Somebody looks on while episodes are scored; what he sees changes no score by a bit."""

    def due(self) -> bool:
        """Whether the present step is to be shown: far fewer are than are made."""

    def see(self, episode: int, look: Callable[[], StepSnapshot]) -> None:
        """Look at a step of one of the episodes that are scored together, by its place among them."""


@dataclass(frozen=True)
class DreamReward:
    """What a dreamt step is worth where the MDN-RNN predicts no reward itself: `gain * value - cost`.

    `value` is the output of the head for the reward's label, or, for `survival`, whether the dream goes on.
    """

    gain: float
    cost: float = 0.0
    source: Literal["label", "survival"] = "label"


@dataclass(frozen=True)
class World:
    """All that the rest of the system must know of a world."""

    actions: Actions
    packages: tuple[str, ...] = ("numpy", "gymnasium")  # distributions whose versions a fitness may depend on
    idle_cost: float = 0.0  # what a step without a reward costs: charged for steps that `patience` cuts off
    horizon: int = ENVIRONMENT_LIMIT  # steps of a judged episode at most
    version: int = 1  # to be raised whenever the same parameters and seeds give another fitness
    time_cost: float = 0.0  # what a candidate pays for each step until `finish`, or its horizon; nobody who is judged
    stray_cost: float = 0.0  # what it pays for each step whose `info` says `stray`; of 100 an episode at most
    frames_per_second: int = 30  # of a video
    action_names: tuple[str, ...] = ()  # of continuous actions, for people
    dream_reward: DreamReward | None = None  # of worlds that world models are trained on
    stray: str = ""  # of the environment's `info`: whether it left the course in this step; empty: it does not say
    threshold: float | None = None  # mean score at which gymnasium has the world for solved; `None`: it says none
    finish: str = ""  # of the environment's `info`: whether the course was driven to its end; empty: it does not say


@dataclass(frozen=True)
class Assignment:
    """What is to be scored: the run's specification and, for tasks that need one, its world model."""

    spec: TaskSpec
    bundle: Bundle | None = None

    def __post_init__(self) -> None:
        """`BundleError` for another world model than the specification names: a fitness would be of another run."""
        if self.bundle is not None and self.bundle.sha256 != self.spec.bundle:
            raise BundleError(
                f"{self.bundle.path} is the world model {self.bundle.sha256[:12]}..., and what is scored in is "
                f"{self.spec.bundle[:12]}...: put the right one there"
            )

    @classmethod
    def of(cls, task: str, bundle: Bundle) -> Assignment:
        """A task on a world model outside of any run."""
        return cls(TaskSpec(task, bundle.sha256, ENVIRONMENT_LIMIT, 0), bundle)

    @property
    def world_model(self) -> Bundle:
        """The bundle, under the run's controllers and variant; `BundleError` where there is none."""
        spec = self.spec
        if self.bundle is None:
            raise BundleError(f"task {spec.task} needs a world model: give one with --bundle")
        own = spec.controller or spec.options
        return self.bundle.with_controllers(spec.controller, Variant.from_json(spec.options)) if own else self.bundle

    @property
    def controller(self) -> ControllerShape:
        """The controllers that are scored."""
        if self.spec.controller is None:
            return self.world_model.controller_shape
        return self.spec.controller


class Task:
    """One thing to score in; what is not told here is refused by name when the task is looked up.

    A subclass gives `name`, `world` and `make_environment`; one that needs no bundle also `describe(options)`: the
    `Description` that a new run freezes, or `UsageError` for an option that it does not know. Its policy is a linear or
    hidden controller on the flat observation unless `make_policy` says otherwise.
    """

    name: str
    width: ClassVar[int] = 1  # episodes that a slot scores at once
    # Of an episode of fixed seed and parameters by which a worker finds out its host's class, before it is given
    # anything to score; 0: nobody looks, and the host's fingerprint tells its class.
    probe_steps: ClassVar[int] = 16
    world: World

    def world_of(self, assignment: Assignment) -> World:  # noqa: ARG002 - a dream asks its bundle
        """The world that is scored in."""
        return self.world

    def reality(self, assignment: Assignment) -> Task:  # noqa: ARG002 - a dream asks its bundle
        """The task of the world that whole episodes are driven in: itself, unless it dreams."""
        return self

    def make_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any]:
        """A new environment; its observations are what the policy takes."""
        raise NotImplementedError

    def make_judge(self, assignment: Assignment, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The environment that reported scores and videos come from; the same where there is no second one."""
        if render_mode is not None:
            raise UsageError(f"task {self.name} draws no pictures: its make_judge takes no render_mode")
        return self.make_environment(assignment)

    def make_shown(self, assignment: Assignment) -> gymnasium.Env[Any, Any] | None:  # noqa: ARG002 - as above
        """What candidates are scored in while somebody looks on, where it takes another environment to have pictures.

        The same to the bit, and `render` gives pictures and changes nothing. `None`: there is none, and what the
        policy observes is shown if it is a picture.
        """
        return None

    def make_policy(self, assignment: Assignment) -> Policy:
        """What drives; `BundleError` if the bundle is of another task."""
        return FlatPolicy(assignment.controller, self.world_of(assignment).actions)


class Batch(Protocol):
    """Scores many episodes together; each is the same bits alone."""

    def score(self, episodes: Sequence[Episode], on_step: Callable[[int], None]) -> list[Score]:
        """The score of each; `on_step` hears of all steps made so far."""


@runtime_checkable
class WatchableBatch(Protocol):
    """A batch that somebody may look on at."""

    def watched(self, observer: StepObserver) -> Batch:
        """The same batch, which shows the onlooker one of its episodes; its scores are the same bits."""


@runtime_checkable
class BatchedTask(Protocol):
    """A task that scores candidates in batches, beside its environment, in which its means are evaluated."""

    def make_batch(self, assignment: Assignment) -> Batch:
        """What scores candidates; `BundleError` if the bundle has no such thing.

        Called again whenever the specification's temperature, horizon or patience changes.
        """


@dataclass(frozen=True)
class Preprocessing:
    """One way from an environment's observation to the picture that a world model sees."""

    name: str  # in bundles' manifests and in recorded rollouts
    size: int  # height and width of its pictures
    picture: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]  # to `(size, size, 3)`, both uint8
    mirrors: bool = True  # whether a picture turned left for right is one of a drive that steers the other way

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width and channels of its pictures."""
        return self.size, self.size, 3


@runtime_checkable
class RecordableTask(Protocol):
    """A task whose world rollouts are recorded in and world models are trained on."""

    name: str
    world: World
    preprocessings: Mapping[str, Preprocessing]
    drivers: Mapping[str, Callable[[np.random.Generator], Driver]]
    """Random drivers by name, in the order in which collecting takes them in turn."""

    def make_recorded(self, preprocessing: str) -> gymnasium.Env[Any, Any]:
        """An environment that observes the pictures of one of its preprocessings."""

    def begin_anywhere(self, environment: gymnasium.Env[Any, Any], random: np.random.Generator) -> Any:
        """Move a reset environment to somewhere else in its world; what is observed there."""


@runtime_checkable
class TaskWithPolicies(Protocol):
    """A task that also drives for data sets as others did for theirs."""

    policies: Mapping[str, Callable[[np.random.Generator], Policy]]
    """Random policies by name, each for one drive; none is taken unless it is named."""


@runtime_checkable
class TaskWithTrueState(Protocol):
    """A task whose worlds tell their true state.

    `dreamfleet inspect` measures world models against it, and `dreamfleet evaluate` tells how a controller drove.
    """

    def truth(self, environment: gymnasium.Env[Any, Any]) -> dict[str, float]:
        """The true state behind the last observation, the same names at every step.

        A world whose road can be lost names `off_road`, 1 or 0, and how far off it is `lateral_offset`; one in which
        something drives names its `speed`.
        """
