"""How much of an episode is chosen at random."""

from __future__ import annotations

from dreamfleet.worker.baselines.learning_config import LearningConfig


def epsilon_of(config: LearningConfig, episode: int) -> float:
    """The share of random choices in an episode, counted from 0: all at first, then falling in a line to the last."""
    since = episode - config.random_episodes
    if since < 0:
        return 1.0
    fallen = min(1.0, since / config.epsilon_episodes)
    return config.epsilon_first + fallen * (config.epsilon_last - config.epsilon_first)
