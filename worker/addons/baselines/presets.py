"""The recurrent duelling network's layers, the hyperparameters of its training, and presets of both; without torch."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from dreamfleet.common.artifacts.actions import FIVE_CHOICES
from dreamfleet.common.cli.bounds import NotNegative, Positive, check_bounds
from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.messages import Share
from dreamfleet.common.schema.validation import Count
from dreamfleet.worker.addons.evaluation.named_agents import DISCRETE, RANDOM
from dreamfleet.worker.worlds.trained_agent import MAX_FRAME_SKIP

DRQN = "drqn"
NAMES = (RANDOM, DISCRETE, DRQN)  # of the baselines
CHECKPOINT = "drqn.safetensors"  # in the folder of a training
MOST_PARAMETERS = 50_000_000  # readers of an exported network bound its size

# Steering, gas, brake of each choice, in gymnasium's order: nothing, right, left, gas, brake.
CHOICES: dict[str, tuple[tuple[float, ...], ...]] = {
    "gymnasium": FIVE_CHOICES.choices,
    "notebook": ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, 1)),
}


@dataclass(frozen=True)
class AgentConfig:
    """Layers, pictures and choices: all that a trained network needs besides its weights.

    The layers are those of Hausknecht & Stone 2015 (arXiv:1507.06527) with the streams of Wang et al. 2016
    (arXiv:1511.06581).
    """

    picture: int = option(64, "height and width of its pictures: 64, or 96 for the whole observation")
    choices: Literal["gymnasium", "notebook"] = option(
        "gymnasium", "its five actions: steering 0.6, gas 0.2, brake 0.8 as gymnasium has them, or 1 each (notebook)"
    )
    frame_skip: int = option(1, "steps for which a choice is held")
    channels: tuple[int, ...] = option((32, 64, 64), "of each convolution")
    kernels: tuple[int, ...] = option((8, 4, 3), "of each convolution")
    strides: tuple[int, ...] = option((4, 2, 1), "of each convolution")
    hidden: int = option(512, "units of the LSTM")
    heads: Literal["linear", "softmax"] = option(
        "linear", "softmax bounds the advantages to 0..1, as the notebook does; they then cannot represent returns"
    )

    def __post_init__(self) -> None:
        if self.picture not in (64, 96):
            raise UsageError(f"picture must be 64 or 96, not {self.picture}")
        counts = {len(self.channels), len(self.kernels), len(self.strides)}
        if len(counts) > 1 or 0 in counts:
            raise UsageError("channels, kernels and strides must name the same number of layers, at least one")
        if min(*self.channels, *self.kernels, *self.strides, self.hidden, self.frame_skip) < 1:
            raise UsageError("channels, kernels, strides, hidden and frame_skip must be at least 1")
        if min(self.sides) < 1:
            raise UsageError(f"kernels and strides leave nothing of {self.picture} pixels: make them smaller")
        if self.frame_skip > MAX_FRAME_SKIP:
            raise UsageError(f"frame_skip must be at most {MAX_FRAME_SKIP}, not {self.frame_skip}")
        if self.parameters > MOST_PARAMETERS:
            raise UsageError(
                f"these layers have {self.parameters:,} parameters, at most {MOST_PARAMETERS:,} are allowed: make "
                "channels, kernels or hidden smaller"
            )

    @property
    def sides(self) -> tuple[int, ...]:
        """Height (= width) of the picture, then after each convolution."""
        sides = [self.picture]
        for kernel, stride in zip(self.kernels, self.strides, strict=True):
            sides.append((sides[-1] - kernel) // stride + 1)
        return tuple(sides)

    @property
    def flat(self) -> int:
        """The number of outputs of the last convolution."""
        return int(self.channels[-1] * self.sides[-1] ** 2)

    @property
    def channel_pairs(self) -> tuple[tuple[int, int], ...]:
        """Channels before and after each convolution."""
        return tuple(pairwise((3, *self.channels)))

    @property
    def parameters(self) -> int:
        """The number of weights of the convolutions and the LSTM, which are nearly all; biases are not counted."""
        layers = zip(self.channel_pairs, self.kernels, strict=True)
        looking = sum(before * after * kernel**2 for (before, after), kernel in layers)
        return int(looking + 4 * self.hidden * (self.flat + self.hidden))

    @property
    def table(self) -> tuple[tuple[float, ...], ...]:
        """Steering, gas and brake of each choice: `(choices, 3)`."""
        return CHOICES[self.choices]


MOST_READ = 100_000  # pictures of one update: about 5 GB at 64 pixels, as float32


@dataclass(frozen=True)
class LearningConfig:
    """Hyperparameters of one training. A decision is one choice of the agent, repeated for `frame_skip` steps."""

    episodes: Positive = option(1000, "total number to drive")
    random_episodes: Count = option(20, "first ones, driven at random and without learning")
    steps: Positive = option(1000, "longest episode, in environment steps")
    patience: Count = option(0, "steps without a reward after which an episode is truncated; 0: never")
    batch: Positive = option(32, "traces per update")
    trace: Positive = option(8, "decisions of a trace that are learnt from")
    burn_in: Count = option(4, "decisions before them that only warm up the LSTM's memory")
    n_step: Positive = option(1, "rewards summed before the Q value stands for the rest")
    gamma: Share = option(0.99, "discount of a reward per decision")
    epsilon_first: Share = option(1.0, "share of random choices after the random episodes")
    epsilon_last: Share = option(0.05, "share of random choices at the end")
    epsilon_episodes: Positive = option(300, "episodes over which it falls from the first to the last")
    rate: NotNegative = option(1e-4, "Adam's learning rate")
    clip: NotNegative = option(10.0, "largest norm of the gradients; 0: no limit")
    loss: Literal["huber", "squared"] = option("huber", "of the difference between prediction and target")
    learn_every: Positive = option(4, "decisions between two updates")
    target_every: Positive = option(500, "updates after which the target network becomes a copy of the online one")
    replay: Positive = option(50_000, "capacity of the replay buffer in decisions; it holds whole episodes")
    goal: float = option(900.0, "training ends when a report's episodes reach this mean score")
    report_every: Positive = option(5, "episodes between two reports")
    seed: Count = option(0, "random seed of the training")

    def __post_init__(self) -> None:
        check_bounds(self, are_flags=False)
        if (read := self.batch * (self.burn_in + self.trace + self.n_step)) > MOST_READ:
            raise UsageError(
                f"an update would read {read:,} pictures, {MOST_READ:,} at most: make batch, trace, burn_in or "
                "n_step smaller"
            )
        if not (self.rate and math.isfinite(self.goal)):
            raise UsageError(f"rate must be above 0 and goal a number, not {self.rate} and {self.goal}")


def epsilon_of(config: LearningConfig, episode: int) -> float:
    """The share of random choices in episode `episode` (from 0): 1 at first, then a linear decay to `epsilon_last`."""
    since = episode - config.random_episodes
    if since < 0:
        return 1.0
    fallen = min(1.0, since / config.epsilon_episodes)
    return config.epsilon_first + fallen * (config.epsilon_last - config.epsilon_first)


@dataclass(frozen=True)
class BaselinePreset:
    """A network's layers and the hyperparameters of its training."""

    name: str
    agent: AgentConfig
    learning: LearningConfig


# A notebook's settings (docs/explanation/sources.md). It does not give learning rate, layer sizes, replay size, and how
# often it learns and copies the target: these are ours. Its LSTM sees single transitions, its advantages lie between 0
# and 1, and full gas spins the car, so that its score stays at about -20 to -60.
NOTEBOOK = BaselinePreset(
    name="notebook",
    agent=AgentConfig(picture=96, choices="notebook", heads="softmax", channels=(16, 32, 32), hidden=128),
    learning=LearningConfig(
        episodes=500, random_episodes=50, batch=64, trace=1, burn_in=0, n_step=1, gamma=0.99, epsilon_first=0.6,
        epsilon_last=0.1, epsilon_episodes=450, rate=1e-3, clip=0, loss="squared", replay=10_000,
    ),
)  # fmt: skip
LEARNING = BaselinePreset(
    name="learning",
    agent=AgentConfig(frame_skip=4, channels=(16, 32, 32), hidden=128),
    learning=LearningConfig(
        episodes=2000, patience=100, batch=16, trace=8, burn_in=4, n_step=3, epsilon_episodes=100, rate=2.5e-4,
    ),
)  # fmt: skip
PRESETS = {preset.name: preset for preset in (LEARNING, NOTEBOOK)}
