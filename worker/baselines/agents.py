"""The baselines by name, ready to be judged and recorded: random drivers, and a network that was trained."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from dreamfleet.common.errors import MissingExtraError, UsageError
from dreamfleet.common.fingerprint import NUMERIC_PACKAGES
from dreamfleet.worker.baselines.names import DISCRETE, DRQN
from dreamfleet.worker.baselines.policies import QPolicy, RandomPolicy
from dreamfleet.worker.car_racing.preprocessing import RAW
from dreamfleet.worker.tasks.api import Policy
from dreamfleet.worker.training.world import preprocessing_to

if TYPE_CHECKING:
    from dreamfleet.worker.baselines.network import QNetwork


class Agent(Protocol):
    """Who drives, whatever was learnt."""

    @property
    def sha256(self) -> str:
        """Of all that its choices follow from, but the picture and the episode's seed."""

    @property
    def preprocessing(self) -> str:
        """Name of what makes the pictures that it sees."""

    @property
    def packages(self) -> tuple[str, ...]:
        """Distributions whose versions its scores may depend on."""

    def policy(self, seed: int) -> Policy:
        """It at the wheel in the episode of a seed."""


@dataclass(frozen=True)
class RandomAgent:
    """One of the random drivers; its chance is the episode's."""

    name: str
    preprocessing: str = RAW.name
    packages: tuple[str, ...] = NUMERIC_PACKAGES

    @property
    def sha256(self) -> str:
        """Of its name."""
        return hashlib.sha256(self.name.encode()).hexdigest()

    def policy(self, seed: int) -> RandomPolicy:
        """At the wheel."""
        return RandomPolicy(np.random.default_rng(seed), discrete=self.name == DISCRETE)


class TrainedAgent:
    """A network that takes what it holds to be best."""

    packages = (*NUMERIC_PACKAGES, "torch")

    def __init__(self, network: QNetwork) -> None:
        self._network = network
        self.preprocessing = preprocessing_to(network.config.picture).name

    @property
    def sha256(self) -> str:
        """Of its layers and weights."""
        digest = hashlib.sha256(json.dumps(asdict(self._network.config), sort_keys=True).encode())
        for name, tensor in sorted(self._network.state_dict().items()):
            digest.update(name.encode() + tensor.cpu().numpy().astype("<f4").tobytes())
        return digest.hexdigest()

    def policy(self, _seed: int) -> QPolicy:
        """At the wheel."""
        return QPolicy(self._network)


def find_agent(name: str, data: Path | None) -> Agent:
    """A baseline by name; the network lies in the folder `data` of its training.

    `UsageError` where a folder is missing or needless, `DatasetError` for a checkpoint that is damaged or no agent's.
    """
    if name != DRQN:
        if data is not None:
            raise UsageError(f"{name} learns nothing: leave --data out")
        return RandomAgent(name)
    if data is None:
        raise UsageError(f"{DRQN} needs --data: the folder in which `dreamfleet baseline train {DRQN}` keeps it")
    return TrainedAgent(_read(data))


def _read(folder: Path) -> QNetwork:
    """The network, on one thread of torch: its bits must not hang on how many there are."""
    if find_spec("torch") is None:
        raise MissingExtraError(f"{DRQN} needs torch, which is not installed: pip install 'dreamfleet[train]'")
    import torch

    from dreamfleet.worker.baselines.agent_config import AgentConfig
    from dreamfleet.worker.baselines.network import Networks
    from dreamfleet.worker.baselines.train import CHECKPOINT
    from dreamfleet.worker.training.checkpoint import load_checkpoint, load_config

    path = folder / CHECKPOINT
    if not path.exists():
        raise UsageError(f"no agent at {path}: train one with `dreamfleet baseline train {DRQN} --data {folder}`")
    networks = Networks(load_config(path, AgentConfig))
    load_checkpoint(path, networks, None)
    torch.set_num_threads(1)
    return networks.online.eval()
