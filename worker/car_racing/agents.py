"""Who drives CarRacing by its pictures, without a world model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE
from dreamfleet.common.artifacts.onnx_checks import check_self_contained
from dreamfleet.common.artifacts.trained_agent import NETWORK, TrainedAgent
from dreamfleet.common.errors import ControllerError
from dreamfleet.worker.car_racing.frame_skip_policy import FrameSkipPolicy
from dreamfleet.worker.car_racing.preprocessing import PREPROCESSINGS, find_preprocessing
from dreamfleet.worker.car_racing.task import WORLD, CarRacingTask, make_reference_environment
from dreamfleet.worker.tasks.api import Policy, World
from dreamfleet.worker.worldmodel.inference import open_graph

Floats = NDArray[np.float32]
NO_PARAMETERS = np.zeros(0, np.float32)  # the parameters of who has none


class PictureAgent(ABC):
    """An agent, as `scoring.agents` has it, that sees the pictures of a preprocessing."""

    task: ClassVar[str] = CarRacingTask.name
    reality: ClassVar[str] = CarRacingTask.name
    world: ClassVar[World] = WORLD
    threshold: ClassVar[float | None] = WORLD.threshold
    bundle: ClassVar[None] = None
    parameters: ClassVar[Floats] = NO_PARAMETERS

    @property
    @abstractmethod
    def sha256(self) -> str:
        """Of all that its choices follow from, but the picture and the episode's seed."""

    @property
    @abstractmethod
    def preprocessing(self) -> str:
        """Name of what makes the pictures that it sees."""

    @abstractmethod
    def make_policies(self) -> Callable[[int], Policy]:
        """It at the wheel in the episode of a seed."""

    def make_evaluation_environment(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The unmodified environment of gymnasium, observing what it sees."""
        return make_reference_environment(find_preprocessing(self.preprocessing), render_mode)

    @property
    def truth(self) -> Callable[[gymnasium.Env[Any, Any]], dict[str, float]]:
        """The task's."""
        return CarRacingTask().truth


@dataclass(frozen=True)
class NetworkAgent(PictureAgent):
    """A trained agent, by its file alone; `ControllerError` for one that cannot drive here."""

    trained: TrainedAgent

    def __post_init__(self) -> None:
        manifest, actions = self.trained.manifest, STEERING_GAS_BRAKE
        if manifest.task != self.task or manifest.preprocessing not in PREPROCESSINGS:
            raise ControllerError(
                f"the agent sees {manifest.preprocessing!r} of {manifest.task!r}: {self.task} gives "
                f"{' or '.join(PREPROCESSINGS)}"
            )
        for each in manifest.choices:
            if len(each) != actions.actions or (np.clip(each, actions.low, actions.high) != each).any():
                raise ControllerError(f"the agent's choice {each} is no steering, gas and brake: export it again")
        NetworkPolicy(self.trained).act(np.zeros(PREPROCESSINGS[manifest.preprocessing].shape, np.uint8))

    @property
    def sha256(self) -> str:
        """The trained agent's own."""
        return self.trained.sha256

    @property
    def preprocessing(self) -> str:
        """As the agent's manifest says."""
        return self.trained.manifest.preprocessing

    def make_policies(self) -> Callable[[int], NetworkPolicy]:
        """The same in each episode."""
        policy = NetworkPolicy(self.trained)
        return lambda _seed: policy


class NetworkPolicy(FrameSkipPolicy):
    """The choice that the network gives most worth, of equal ones the first."""

    def __init__(self, trained: TrainedAgent) -> None:
        manifest = trained.manifest
        super().__init__(manifest.choices, manifest.frame_skip)
        try:
            check_self_contained(trained.network)
            self._run = open_graph(trained.network, threads=1).run
        except Exception as error:  # the runtime's errors share no public base
            raise _unusable_network_error(error) from error
        self._zero = np.zeros((1, manifest.state), np.float32)
        self._state = self._zero

    def reset_memory(self) -> None:
        """Nothing is remembered."""
        self._state = self._zero

    def choose(self, picture: NDArray[np.uint8]) -> int:
        """The best; `ControllerError` where the network tells no worth of each choice."""
        try:
            worth, self._state = self._run(["worth", "next_state"], {"picture": picture[None], "state": self._state})
        except Exception as error:  # as above
            raise _unusable_network_error(error) from error
        if (
            worth.shape != (1, len(self._actions))
            or self._state.shape != self._zero.shape
            or not np.isfinite(worth).all()
        ):
            raise _unusable_network_error(f"it tells {worth.shape} of {len(self._actions)} choices, or no numbers")
        return int(worth[0].argmax())


def _unusable_network_error(why: object) -> ControllerError:
    return ControllerError(f"the agent's {NETWORK} cannot be run ({' '.join(str(why).split())}): export it again")
