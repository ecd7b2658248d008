"""The contract of a task: an environment, the policy that acts in it, and what the rest of the system knows of it.

A package with a task imports only this module; docs/reference/tasks.md has an example. The dream, the real track and
any gymnasium environment satisfy the same contract.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE, Actions, Continuous, Discrete, Mirror, one_hot
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts, WorldFacts
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import Description
from dreamfleet.common.schema.display import DisplayedFields
from dreamfleet.worker.tasks.policy import Driver, FlatPolicy

__all__ = [
    "STEERING_GAS_BRAKE", "Actions", "Assignment", "Batch", "BatchedTask", "Continuous", "Description", "Discrete",
    "DreamReward", "Driver", "EndRule", "Episode", "Mirror", "Policies", "Policy", "PolicySideBySide",
    "PolicyWithOutputs", "Preprocessing", "RecordableTask", "RewardAwarePolicy", "RewardFacts", "Score",
    "StepObserver", "StepSnapshot", "Task", "TaskWithBeginnings", "TaskWithOptions", "TaskWithPolicies",
    "TaskWithTrueState", "WatchableBatch", "World", "WorldFacts", "one_hot",
]  # fmt: skip

ENVIRONMENT_LIMIT = 10**6  # steps: the environment's own limit ends an episode


class Policy(Protocol):
    """Turns observations into actions, with the parameters of one controller.

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


class RewardAwarePolicy(Protocol):
    """Optional: a policy that is informed of rewards.

    >>> from dreamfleet import find_controller, make_policy
    >>> policy = make_policy(find_controller("tiny"))
    >>> action = policy.act(np.zeros((64, 64, 3), np.uint8))
    >>> policy.reward(-0.1)
    """

    def reward(self, value: float) -> None:
        """Called with the reward of the last action, before the next `act`."""


class PolicyWithOutputs(Protocol):
    """Optional: a policy whose actions hide the numbers they come from, for example the index of the largest output.

    >>> policy = FlatPolicy(ControllerShape(features=1, actions=2), Discrete(2))
    >>> policy.begin(np.array([1, -1, 0, 0], np.float32))
    >>> policy.outputs(3.0).tolist(), int(policy.act(3.0))
    ([3.0, -3.0], 0)
    """

    def outputs(self, observation: Any) -> Any:
        """The numbers that an action comes from, as one or more arrays. Their bits distinguish host classes too."""


class Policies(Protocol):
    """Several controllers that act side by side, one a row; an action has the bits that it has alone.

    >>> from dreamfleet import find_controller, make_policy
    >>> controller = find_controller("tiny")
    >>> policies = make_policy(controller).side_by_side()
    >>> policies.begin(np.stack([controller.parameters, -controller.parameters]))
    >>> policies.act(np.zeros((2, 64, 64, 3), np.uint8)).shape
    (2, 3)
    """

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Start an episode for each row of `parameters` `(rows, size)`."""

    def act(self, observations: NDArray[Any]) -> NDArray[Any]:
        """An action for each of the observations `(rows, ...)`."""

    def reward(self, values: NDArray[np.float64]) -> None:
        """Called with the rewards `(rows,)` of the last actions, before the next `act`."""

    def keep(self, rows: Sequence[int]) -> None:
        """Go on with these rows alone: the other episodes are over."""


@runtime_checkable
class PolicySideBySide(Protocol):
    """Optional: a policy that can act for several episodes at once.

    If its task has a `batch_size` of more than 1, a slot drives up to that many episodes side by side, each in an
    environment of its own. The worker finds which number of them takes least time a step.

    >>> from dreamfleet import find_controller, make_policy
    >>> isinstance(make_policy(find_controller("tiny")), PolicySideBySide)
    True
    """

    def side_by_side(self) -> Policies:
        """The same policy for several controllers."""


@dataclass(frozen=True)
class Score:
    """Result of an episode: its fitness, the number of environment steps, and the specification's measures.

    >>> Score(fitness=812.5, steps=1000).fitness
    812.5
    """

    fitness: float
    steps: int
    measures: tuple[float, ...] = ()


Episode = tuple[NDArray[np.float32], int]
"""A candidate's flat parameter vector, and the seed of the episode."""


class StepSnapshot(NamedTuple):
    """One step of an episode for a live view, taken before its action is applied.

    >>> snapshot = StepSnapshot(step=3, score=1.5, action=np.zeros(3, np.float32))
    >>> snapshot.step, snapshot.picture
    (3, None)
    """

    step: int  # number of steps before it
    score: float  # sum of the rewards of those
    action: NDArray[Any]  # the action of this step
    picture: NDArray[np.uint8] | None = None  # (height, width, 3)
    latent: NDArray[np.float32] | None = None  # (latent,), of a world model
    state: NDArray[np.float32] | None = None  # (state,), the world model's before the action


class StepObserver(Protocol):
    """Receives some steps of episodes while they are scored. It changes no score.

    >>> from dreamfleet import Scorer
    >>> class Steps(list):
    ...     def is_due(self):
    ...         return True
    ...     def observe(self, episode, look):
    ...         self.append(look().step)
    >>> scorer = Scorer(TaskSpec("gym:CartPole-v1", "", horizon=3, patience=0, controller=ControllerShape(4, 2)))
    >>> scorer.observer = Steps()
    >>> score = scorer.score("score", np.zeros(10, np.float32), seed=1)
    >>> scorer.observer
    [0, 1, 2]
    """

    def is_due(self) -> bool:
        """Whether to call `observe` for the present step; true for few steps."""

    def observe(self, episode: int, look: Callable[[], StepSnapshot]) -> None:
        """Receive a step of the episode with this index in its batch; `look()` makes the snapshot."""


@dataclass(frozen=True)
class DreamReward:
    """The reward of a dreamt step where the MDN-RNN does not predict it: `gain * value - cost`.

    `value` is the output of the head for the reward's label, or, with `survival`, 1 if the dream goes on and else 0.

    >>> DreamReward(gain=1.0, source="survival").cost
    0.0
    """

    gain: float
    cost: float = 0.0
    source: Literal["label", "survival"] = "label"


@dataclass(frozen=True, repr=False)
class World(DisplayedFields):
    """What the rest of the system must know of a world; `UsageError` for a mirror or names of other actions.

    The last six fields are of worlds in which world models are trained (docs/reference/worlds.md).

    >>> from dreamfleet import Continuous, Discrete, World
    >>> World(Continuous.between(low=[-2], high=[2]), horizon=200).actions.outputs
    1
    >>> World(Discrete(2), horizon=200)  # what differs from the defaults
    World(actions=Discrete(outputs=2, first=0), horizon=200)
    """

    actions: Actions
    packages: tuple[str, ...] = ("numpy", "gymnasium")  # distributions on whose versions a fitness may depend
    idle_cost: float = 0.0  # charged for each step that `patience` cuts off: what a step without a reward costs
    horizon: int = ENVIRONMENT_LIMIT  # most steps of an evaluation episode
    version: int = 1  # raise it whenever the same parameters and seeds give another fitness
    time_cost: float = 0.0  # charged to a candidate for each step until `finish` or its horizon; never in evaluations
    off_course_cost: float = 0.0  # charged to a candidate for each step off the course, of 100 an episode at most
    frames_per_second: int = 30  # of videos
    action_names: tuple[str, ...] = ()  # labels of continuous actions, one for each
    dream_reward: DreamReward | None = None  # for world models that predict no reward
    off_course: str = ""  # key of the environment's `info`: whether this step left the course; empty: there is none
    threshold: float | None = None  # mean score at which gymnasium considers the world solved; `None`: unknown
    finish: str = ""  # key of the environment's `info`: whether the course was driven to its end; empty: there is none
    judge: str = ""  # "gymnasium" where reported scores are of its own environment
    score_word: str = "seed"  # what a scored seed is called: "track", "game"
    marks: tuple[float, ...] = ()  # scores to compare with: reports say what share of the episodes exceeds each
    mirror: Mirror | None = None  # the action in a left-right mirrored picture; `None`: such pictures show no drive
    lost_after: int = 0  # steps without a reward that are a loss of the course; 0: a loss is a death
    opening: int = 0  # first steps of an episode that measurements leave out, while a camera moves
    preset: str = "pixels"  # training preset of a new data set

    def __post_init__(self) -> None:
        own = self.actions.actions if isinstance(self.actions, Continuous) else 0
        if self.mirror is not None and len(self.mirror.order) != own:
            raise UsageError(f"a mirror of {plural(len(self.mirror.order), 'column')} does not fit {own} actions")
        if own and len(self.action_names) not in (0, own):
            raise UsageError(f"{len(self.action_names)} action_names do not fit {own} actions: give one for each")

    def facts(self, reward: RewardFacts, end: EndRule, options: str = "") -> WorldFacts:
        """What a bundle's manifest says of this world, under a task's `options`; `UsageError` for numbered actions.

        >>> World(one_hot(3), frames_per_second=9).facts(RewardFacts("survival"), EndRule()).actions.outputs
        3
        """
        if not isinstance(self.actions, Continuous):
            raise UsageError("a world model sees actions as vectors: give the world `one_hot` actions, not Discrete")
        return WorldFacts.of(
            self.actions, reward=reward, end=end, options=options, packages=self.packages, horizon=self.horizon,
            frames_per_second=self.frames_per_second, version=self.version, score_word=self.score_word,
            marks=tuple(map(float, self.marks)), action_names=self.action_names,
        )  # fmt: skip


@dataclass(frozen=True)
class Assignment:
    """What is scored: a run's specification and, for tasks that need one, its world model.

    >>> from dreamfleet import find_bundle
    >>> Assignment.of("dream", find_bundle("tiny")).controller.size
    867
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
        if self.spec.controller is None:
            return self.world_model.controller_shape
        return self.spec.controller


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
        self, assignment: Assignment  # noqa: ARG002 - subclasses use it
    ) -> gymnasium.Env[Any, Any] | None:  # fmt: skip
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


class Batch(Protocol):
    """Scores many episodes together; each score has the same bits as when it is scored alone.

    >>> from dreamfleet import find_bundle, find_controller
    >>> from dreamfleet.worker.tasks.registry import find_task
    >>> bundle, parameters = find_bundle("tiny"), find_controller("tiny").parameters
    >>> spec = TaskSpec("dream", bundle.sha256, horizon=50, patience=0)
    >>> batch = find_task("dream").make_batch(Assignment(spec, bundle))
    >>> done = []
    >>> scores = batch.score([(parameters, 1), (parameters, 2)], on_step=done.append)
    >>> [score.steps for score in scores], done[-1]
    ([50, 50], 100)
    """

    def score(self, episodes: Sequence[Episode], on_step: Callable[[int], None]) -> list[Score]:
        """The score of each episode; calls `on_step` with the number of steps so far, over all episodes."""


@runtime_checkable
class WatchableBatch(Protocol):
    """Optional: a batch whose episodes can be watched.

    >>> from dreamfleet import find_bundle
    >>> from dreamfleet.worker.tasks.registry import find_task
    >>> batch = find_task("dream").make_batch(Assignment.of("dream", find_bundle("tiny")))
    >>> isinstance(batch, WatchableBatch)
    True
    """

    def watched(self, observer: StepObserver) -> Batch:
        """The same batch with the same scores, which passes steps of one episode to `observer`."""


@runtime_checkable
class BatchedTask(Protocol):
    """Optional: a task that scores candidates in batches. Its evaluations are still driven in its environment.

    >>> from dreamfleet.worker.tasks.registry import find_task
    >>> isinstance(find_task("dream"), BatchedTask)
    True
    """

    def make_batch(self, assignment: Assignment) -> Batch:
        """A batch that scores candidates; `BundleError` if the bundle cannot do that.

        Called again whenever the specification's horizon or patience changes.
        """


@dataclass(frozen=True)
class Preprocessing:
    """A function from an environment's observation to the picture that a world model sees.

    >>> Preprocessing("half", size=48, picture=lambda picture: picture[::2, ::2]).shape
    (48, 48, 3)
    """

    name: str  # as bundles' manifests and recorded rollouts name it
    size: int  # height and width of its pictures
    picture: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]  # to `(size, size, 3)`, both uint8
    mirrors: bool = True  # whether a mirrored picture shows a drive with mirrored steering

    @property
    def shape(self) -> tuple[int, int, int]:
        """Height, width and channels of its pictures."""
        return self.size, self.size, 3


@runtime_checkable
class RecordableTask(Protocol):
    """Optional: a task in whose world rollouts are recorded and world models are trained.

    Its `world` has `Continuous` actions. What `make_recorded` makes takes them as float32 vectors `(actions,)`, and
    observes uint8 `(size, size, 3)`. It says `terminated` where an episode ends by a death, `truncated` by a limit.

    >>> from dreamfleet.worker.tasks.registry import find_task
    >>> task: RecordableTask = find_task("car-racing")
    >>> task.drivers["random-walk"](np.random.default_rng(1)).act().shape
    (3,)
    """

    name: str

    @property
    def world(self) -> World:
        """The world."""

    @property
    def preprocessings(self) -> Mapping[str, Preprocessing]:
        """The kinds of pictures by name."""

    @property
    def drivers(self) -> Mapping[str, Callable[[np.random.Generator], Driver]]:
        """Random drivers by name, in the order in which collecting uses them in turn."""

    def make_recorded(self, preprocessing: str) -> gymnasium.Env[Any, Any]:
        """A new environment that observes the pictures of the preprocessing with this name."""


@runtime_checkable
class TaskWithBeginnings(Protocol):
    """Optional: a recordable task whose drives may also begin at random places in its world.

    >>> from dreamfleet.worker.tasks.registry import find_task
    >>> task = find_task("car-racing")
    >>> with task.make_recorded("box-64") as environment:
    ...     observation, info = environment.reset(seed=1)
    ...     task.begin_anywhere(environment, np.random.default_rng(1)).shape
    (64, 64, 3)
    """

    def begin_anywhere(self, environment: gymnasium.Env[Any, Any], random: np.random.Generator) -> Any:
        """Move a reset environment to a random place in its world; return the observation there."""


@runtime_checkable
class TaskWithOptions(Protocol):
    """Optional: a task that is recorded under options, such as a part of the picture. Data and bundles keep them.

    >>> import json
    >>> class Sized:
    ...     def __init__(self, size=64):
    ...         self.size = size
    ...     def parse_options(self, arguments):
    ...         return json.dumps({"size": int(arguments["size"])}) if arguments else ""
    ...     def with_options(self, options):
    ...         return Sized(**json.loads(options or "{}"))
    >>> task: TaskWithOptions = Sized()
    >>> task.with_options(task.parse_options({"size": "96"})).size
    96
    """

    def parse_options(self, arguments: Mapping[str, Any]) -> str:
        """Canonical JSON of the options that differ from their defaults, empty if none does; `UsageError` else."""

    def with_options(self, options: str) -> Task:
        """The task under these options, as `parse_options` writes them, or empty; a `RecordableTask`.

        It makes no environment: that would start a simulator. `UsageError` for options that it does not have.
        """


@runtime_checkable
class TaskWithPolicies(Protocol):
    """Optional: a task that also has random policies of published data sets.

    >>> from dreamfleet.worker.tasks.registry import find_task
    >>> list(find_task("car-racing").policies)
    ['uniform', 'pushed', 'network']
    """

    policies: Mapping[str, Callable[[np.random.Generator], Policy]]
    """Random policies by name, each for one drive; each is used only if it is named."""


@runtime_checkable
class TaskWithTrueState(Protocol):
    """Optional: a task whose worlds report their true state.

    `dreamfleet inspect` measures world models against it, and `dreamfleet evaluate` reports how a controller drove.

    >>> from dreamfleet.worker.tasks.registry import find_task
    >>> task = find_task("car-racing")
    >>> with task.make_recorded("box-64") as environment:
    ...     observation, info = environment.reset(seed=1)
    ...     task.truth(environment)["speed"]
    0.0
    """

    def truth(self, environment: gymnasium.Env[Any, Any]) -> dict[str, float]:
        """The true state behind the last observation, with the same names at every step.

        A world with a road names `off_road` (1 or 0) and `lateral_offset`, the distance from the road's middle; a world
        in which something drives names its `speed`.
        """
