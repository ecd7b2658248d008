"""The names of the baselines, and the presets of the recurrent duelling network."""

from __future__ import annotations

from dataclasses import dataclass

from dreamfleet.common.cli.presets import check_preset
from dreamfleet.worker.addons.baselines.agent_config import AgentConfig
from dreamfleet.worker.addons.baselines.learning_config import LearningConfig
from dreamfleet.worker.tools.drivers import DISCRETE, RANDOM

DRQN = "drqn"
NAMES = (RANDOM, DISCRETE, DRQN)
CHECKPOINT = "drqn.safetensors"  # in the folder of a training


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


def find_preset(name: str) -> BaselinePreset:
    """Return the preset `name`; `UsageError` lists those that exist."""
    return PRESETS[check_preset("baseline", name)]
