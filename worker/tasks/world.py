"""What the rest of the system knows of a world."""

from dataclasses import dataclass
from typing import Literal

from dreamfleet.common.artifacts.actions import Actions, Continuous, Mirror
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts, WorldFacts
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.schema.display import DisplayedFields

ENVIRONMENT_LIMIT = 10**6  # steps: the environment's own limit ends an episode


@dataclass(frozen=True)
class DreamReward:
    """The reward of a dreamt step where the MDN-RNN does not predict it: `gain * value - cost`.

    `value` is the output of the head for the reward's label, or, with `survival`, 1 if the dream goes on and else 0.
    """

    gain: float
    cost: float = 0.0
    source: Literal["label", "survival"] = "label"


@dataclass(frozen=True, repr=False)
class World(DisplayedFields):
    """What the rest of the system must know of a world; `UsageError` for a mirror or names of other actions.

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
    figures: tuple[str, ...] = ()  # numbers in an episode's last `info` of which reports say the mean
    marks: tuple[float, ...] = ()  # scores to compare with: reports say what share of the episodes exceeds each
    # Of worlds in which world models are trained (docs/reference/worlds.md):
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
        """What a bundle's manifest says of this world, under a task's `options`; `UsageError` for numbered actions."""
        if not isinstance(self.actions, Continuous):
            raise UsageError("a world model sees actions as vectors: give the world `one_hot` actions, not Discrete")
        return WorldFacts.of(
            self.actions, reward=reward, end=end, options=options, packages=self.packages, horizon=self.horizon,
            frames_per_second=self.frames_per_second, version=self.version, score_word=self.score_word,
            marks=tuple(map(float, self.marks)), action_names=self.action_names,
        )  # fmt: skip
