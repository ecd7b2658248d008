"""The baselines by name, ready to be judged and recorded: random drivers, and a network that was trained."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from dreamfleet.common.errors import MissingExtraError, UsageError
from dreamfleet.worker.baselines.policies import RandomPolicy
from dreamfleet.worker.baselines.presets import DISCRETE, DRQN
from dreamfleet.worker.car_racing.agents import NetworkAgent, PictureAgent
from dreamfleet.worker.car_racing.preprocessing import RAW


@dataclass(frozen=True)
class RandomAgent(PictureAgent):
    """One of the random drivers; its chance is the episode's."""

    name: str

    @property
    def sha256(self) -> str:
        """Of its name."""
        return hashlib.sha256(self.name.encode()).hexdigest()

    @property
    def preprocessing(self) -> str:
        """It looks at none."""
        return RAW.name

    def make_policies(self) -> Callable[[int], RandomPolicy]:
        """At the wheel, by the chance of each episode."""
        return lambda seed: RandomPolicy(np.random.default_rng(seed), discrete=self.name == DISCRETE)


def find_baseline(name: str, data: Path | None) -> PictureAgent:
    """A baseline by name; the network lies in the folder `data` of its training, and drives as it would exported.

    `UsageError` where a folder is missing or needless, `DatasetError` for a checkpoint that is damaged or no agent's.
    """
    if name != DRQN:
        if data is not None:
            raise UsageError(f"{name} learns nothing: leave --data out")
        return RandomAgent(name)
    if data is None:
        raise UsageError(f"{DRQN} needs --data: the folder in which `dreamfleet baseline train {DRQN}` keeps it")
    if find_spec("torch") is None:
        raise MissingExtraError(
            f"{DRQN} needs torch, which is not installed: pip install 'dreamfleet[train]'; what `dreamfleet baseline "
            "export` wrote needs none: `dreamfleet evaluate --controller FILE`"
        )
    from dreamfleet.worker.baselines.export import export_agent

    return NetworkAgent(export_agent(data))
