"""Find whom to evaluate, record or watch: a controller, or a baseline, which has no world model."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from dreamfleet.common.errors import MissingExtraError
from dreamfleet.common.files.regular_files import is_file, path_exists
from dreamfleet.common.runs.lookup import find_agent, find_bundle_of
from dreamfleet.worker.baselines.policies import RandomPolicy
from dreamfleet.worker.baselines.presets import CHECKPOINT, DISCRETE, RANDOM
from dreamfleet.worker.car_racing.agents import NetworkAgent, PictureAgent
from dreamfleet.worker.car_racing.preprocessing import RAW
from dreamfleet.worker.scoring.agents import Agent, make_agent


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


def find_driver(name: str, runs_dir: Path, bundle: str | None = None) -> Agent:
    """The agent of this name: what `find_agent` finds, a random driver, or the network in its training's folder.

    `bundle` names another world model than the controller's own. `DatasetError` for a damaged or foreign checkpoint.
    """
    if is_file(Path(name) / CHECKPOINT):
        return _find_network(Path(name))
    if name in (RANDOM, DISCRETE) and not (path_exists(Path(name)) or path_exists(runs_dir / name)):
        return RandomAgent(name)
    controller, beside = find_agent(name, runs_dir)
    return make_agent(controller, find_bundle_of(controller, bundle, beside))


def _find_network(folder: Path) -> Agent:
    if find_spec("torch") is None:
        raise MissingExtraError(
            f"the training in {folder} needs torch, which is not installed: pip install 'dreamfleet[train]'; an agent "
            "that `dreamfleet baseline export` wrote needs no torch: `dreamfleet evaluate --controller FILE`"
        )
    from dreamfleet.worker.baselines.export import export_agent

    return NetworkAgent(export_agent(folder))
