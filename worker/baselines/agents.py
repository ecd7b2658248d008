"""Find a baseline by name, to evaluate and record it: the random drivers, and the trained network."""

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
    """One of the random drivers; the episode's seed is its random seed."""

    name: str

    @property
    def sha256(self) -> str:
        """The SHA-256 of its name, hexadecimal."""
        return hashlib.sha256(self.name.encode()).hexdigest()

    @property
    def preprocessing(self) -> str:
        """It ignores pictures, so the raw ones do."""
        return RAW.name

    def make_policies(self) -> Callable[[int], RandomPolicy]:
        """Return a function from an episode's seed to a policy."""
        return lambda seed: RandomPolicy(np.random.default_rng(seed), discrete=self.name == DISCRETE)


def find_baseline(name: str, data: Path | None) -> PictureAgent:
    """Return the baseline `name`; the network is loaded from `data`, its training's folder, as export would write it.

    `UsageError` for a missing or superfluous folder, `DatasetError` for a damaged or foreign checkpoint.
    """
    if name != DRQN:
        if data is not None:
            raise UsageError(f"{name} learns nothing: leave --data out")
        return RandomAgent(name)
    if data is None:
        raise UsageError(f"{DRQN} needs --data: the folder in which `dreamfleet baseline train {DRQN}` keeps it")
    if find_spec("torch") is None:
        raise MissingExtraError(
            f"{DRQN} needs torch, which is not installed: pip install 'dreamfleet[train]'; an agent that `dreamfleet "
            "baseline export` wrote needs no torch: `dreamfleet evaluate --controller FILE`"
        )
    from dreamfleet.worker.baselines.export import export_agent

    return NetworkAgent(export_agent(data))
