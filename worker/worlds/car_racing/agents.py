"""Agents that drive CarRacing by its pictures, without a world model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE
from dreamfleet.common.errors import ControllerError
from dreamfleet.worker.tasks.api import Policy, World
from dreamfleet.worker.tasks.model_free_policies import NO_PARAMETERS, FrameSkipPolicy
from dreamfleet.worker.worldmodel.inference import open_untrusted_graph
from dreamfleet.worker.worlds.car_racing.preprocessing import PREPROCESSINGS, find_preprocessing
from dreamfleet.worker.worlds.car_racing.task import WORLD, CarRacingTask, make_judging_environment
from dreamfleet.worker.worlds.trained_agent import NETWORK, TrainedAgent

Floats = NDArray[np.float32]


class PictureAgent(ABC):
    """An agent that sees the pictures of a preprocessing."""

    task: ClassVar[str] = CarRacingTask.name
    reality: ClassVar[str] = CarRacingTask.name
    world: ClassVar[World] = WORLD
    options: ClassVar[str] = ""
    bundle: ClassVar[None] = None
    parameters: ClassVar[Floats] = NO_PARAMETERS
    known_score: ClassVar[None] = None

    @property
    @abstractmethod
    def sha256(self) -> str:
        """SHA-256, hexadecimal, of all that its choices depend on besides the picture and the episode's seed."""

    @property
    @abstractmethod
    def preprocessing(self) -> str:
        """The name of the preprocessing of its pictures."""

    @abstractmethod
    def make_policies(self) -> Callable[[int], Policy]:
        """Return a function from an episode's seed to a policy."""

    def make_evaluation_environment(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The environment that scores come from, observing this agent's pictures."""
        return make_judging_environment(find_preprocessing(self.preprocessing), render_mode)

    @property
    def truth(self) -> Callable[[gymnasium.Env[Any, Any]], dict[str, float]]:
        """The task's function from an environment to its true state."""
        return CarRacingTask().truth


@dataclass(frozen=True)
class NetworkAgent(PictureAgent):
    """A trained agent from its file; `ControllerError` if it cannot drive CarRacing."""

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
                raise ControllerError(f"the agent's choice {each} is not steering, gas and brake: export it again")
        NetworkPolicy(self.trained).act(np.zeros(PREPROCESSINGS[manifest.preprocessing].shape, np.uint8))

    @property
    def sha256(self) -> str:
        """The SHA-256 of the trained agent's file."""
        return self.trained.sha256

    @property
    def preprocessing(self) -> str:
        """The preprocessing in the agent's manifest."""
        return self.trained.manifest.preprocessing

    def make_policies(self) -> Callable[[int], NetworkPolicy]:
        """Return a function that gives the same policy for each episode."""
        policy = NetworkPolicy(self.trained)
        return lambda _seed: policy


class NetworkPolicy(FrameSkipPolicy):
    """Takes the choice with the highest Q value; of equal ones the first."""

    def __init__(self, trained: TrainedAgent) -> None:
        manifest = trained.manifest
        super().__init__(manifest.choices, manifest.frame_skip)
        try:
            self._run = open_untrusted_graph(trained.network).run
        except Exception as error:  # the runtime's errors share no public base
            raise _unusable_network_error(error) from error
        self._zero = np.zeros((1, manifest.state), np.float32)
        self._state = self._zero

    def reset_memory(self) -> None:
        """Forget the last episode."""
        self._state = self._zero

    def choose(self, picture: NDArray[np.uint8]) -> int:
        """Return the number of the best choice; `ControllerError` if the network gives no finite value of each."""
        try:
            worth, self._state = self._run(["worth", "next_state"], {"picture": picture[None], "state": self._state})
        except Exception as error:  # as above
            raise _unusable_network_error(error) from error
        if (
            worth.shape != (1, len(self._actions))
            or self._state.shape != self._zero.shape
            or not np.isfinite(worth).all()
        ):
            raise _unusable_network_error(f"it gives {worth.shape} values for {len(self._actions)} choices, or NaN")
        return int(worth[0].argmax())


def _unusable_network_error(why: object) -> ControllerError:
    return ControllerError(f"the agent's {NETWORK} cannot be run ({' '.join(str(why).split())}): export it again")
