"""The hyperparameters of the recurrent duelling network's training."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError

AT_LEAST_ONE = (
    "episodes", "steps", "batch", "trace", "n_step", "epsilon_episodes", "learn_every", "target_every", "replay",
    "report_every",
)  # fmt: skip
MOST = 2**63 - 1  # largest integer that torch and NumPy take
MOST_READ = 100_000  # pictures of one update: about 5 GB at 64 pixels, as float32
NOT_NEGATIVE = ("random_episodes", "patience", "burn_in", "clip", "seed")


@dataclass(frozen=True)
class LearningConfig:
    """Hyperparameters of one training. A decision is one choice of the agent, repeated for `frame_skip` steps."""

    episodes: int = option(1000, "total number to drive")
    random_episodes: int = option(20, "first ones, driven at random and without learning")
    steps: int = option(1000, "longest episode, in environment steps")
    patience: int = option(0, "steps without a reward after which an episode is truncated; 0: never")
    batch: int = option(32, "traces per update")
    trace: int = option(8, "decisions of a trace that are learnt from")
    burn_in: int = option(4, "decisions before them that only warm up the LSTM's memory")
    n_step: int = option(1, "rewards summed before the Q value stands for the rest")
    gamma: float = option(0.99, "discount of a reward per decision")
    epsilon_first: float = option(1.0, "share of random choices after the random episodes")
    epsilon_last: float = option(0.05, "share of random choices at the end")
    epsilon_episodes: int = option(300, "episodes over which it falls from the first to the last")
    rate: float = option(1e-4, "Adam's learning rate")
    clip: float = option(10.0, "largest norm of the gradients; 0: no limit")
    loss: Literal["huber", "squared"] = option("huber", "of the difference between prediction and target")
    learn_every: int = option(4, "decisions between two updates")
    target_every: int = option(500, "updates after which the target network becomes a copy of the online one")
    replay: int = option(50_000, "capacity of the replay buffer in decisions; it holds whole episodes")
    goal: float = option(900.0, "training ends when a report's episodes reach this mean score")
    report_every: int = option(5, "episodes between two reports")
    seed: int = option(0, "random seed of the training")

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, float) and not math.isfinite(value):
                raise UsageError(f"{name} must be a number, not {value}")
            if isinstance(value, int) and value > MOST:
                raise UsageError(f"{name} must be at most {MOST}, not {value}")
        for name in AT_LEAST_ONE:
            if getattr(self, name) < 1:
                raise UsageError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name in NOT_NEGATIVE:
            if getattr(self, name) < 0:
                raise UsageError(f"{name} must not be negative, not {getattr(self, name)}")
        for name in ("gamma", "epsilon_first", "epsilon_last"):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"{name} must be from 0 to 1, not {getattr(self, name)}")
        if (read := self.batch * (self.burn_in + self.trace + self.n_step)) > MOST_READ:
            raise UsageError(
                f"an update would read {read:,} pictures, {MOST_READ:,} at most: make batch, trace, burn_in or "
                "n_step smaller"
            )
        if self.rate <= 0:
            raise UsageError(f"rate must be positive, not {self.rate}")


def epsilon_of(config: LearningConfig, episode: int) -> float:
    """The share of random choices in episode `episode` (from 0): 1 at first, then a linear decay to `epsilon_last`."""
    since = episode - config.random_episodes
    if since < 0:
        return 1.0
    fallen = min(1.0, since / config.epsilon_episodes)
    return config.epsilon_first + fallen * (config.epsilon_last - config.epsilon_first)
