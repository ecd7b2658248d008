"""Agents that act by pictures with a network of their own, in place of a world model and a controller."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.errors import ControllerError
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.tasks.model_free_policies import NO_PARAMETERS, FrameSkipPolicy
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.tasks.registry import find_task, known_tasks
from dreamfleet.worker.tasks.true_state import TaskWithTrueState, Truth
from dreamfleet.worker.worldmodel.inference import open_untrusted_graph
from dreamfleet.worker.worlds.trained_agent import NETWORK, TrainedAgent

Floats = NDArray[np.float32]


@runtime_checkable
class TaskWithTrainedAgents(Protocol):
    """Optional: a task in which trained agents act."""

    @property
    def agent_world(self) -> World:
        """The world in which they act."""

    @property
    def agent_options(self) -> str:
        """The options of the task in which that is its world."""

    @property
    def agent_pictures(self) -> Mapping[str, Preprocessing]:
        """What they may see, by name."""

    def make_agent_environment(self, preprocessing: str, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The environment that scores come from, observing the pictures of this name."""


@runtime_checkable
class TaskWithMaskForAgents(Protocol):
    """Optional: such a task with a twin of that environment, of changed pictures and the same episodes."""

    def make_masked_agent_environment(self, preprocessing: str, *, foreign: bool) -> gymnasium.Env[Any, Any]:
        """The environment with what decides painted out; if `foreign`, with another episode's in its place."""


@dataclass(frozen=True)
class NetworkAgent:
    """A trained agent from its file; `ControllerError` if it cannot act in its task."""

    bundle: ClassVar[None] = None
    parameters: ClassVar[Floats] = NO_PARAMETERS
    known_score: ClassVar[None] = None

    trained: TrainedAgent
    sight: Literal["hidden", "foreign"] | None = None  # of what decides; `None`: its own

    def __post_init__(self) -> None:
        manifest, task = self.trained.manifest, self._task
        if manifest.preprocessing not in task.agent_pictures:
            raise ControllerError(
                f"the agent sees {manifest.preprocessing!r} of {manifest.task!r}: {self.task} gives "
                f"{' or '.join(task.agent_pictures)}"
            )
        actions = task.agent_world.actions
        assert isinstance(actions, Continuous)
        for each in manifest.choices:
            if len(each) != actions.actions or (np.clip(each, actions.low, actions.high) != each).any():
                raise ControllerError(f"the agent's choice {each} is no action of {self.task}: export it again")
        NetworkPolicy(self.trained).act(np.zeros(task.agent_pictures[manifest.preprocessing].shape, np.uint8))

    @property
    def sha256(self) -> str:
        """The SHA-256 of the trained agent's file."""
        return self.trained.sha256

    @property
    def task(self) -> str:
        """The name of its task."""
        return self.trained.task

    @property
    def reality(self) -> str:
        """The same: it is evaluated where it was trained."""
        return self.trained.task

    @property
    def options(self) -> str:
        """The task's options under which it acts."""
        return self._task.agent_options

    @property
    def world(self) -> World:
        """The world in which it acts."""
        return self._task.agent_world

    @property
    def truth(self) -> Truth | None:
        """The task's function from an environment to its true state."""
        task = self._task
        return task.truth if isinstance(task, TaskWithTrueState) else None

    def make_evaluation_environment(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The environment that scores come from, observing this agent's pictures."""
        task, seen = self._task, self.trained.manifest.preprocessing
        if self.sight is not None and isinstance(task, TaskWithMaskForAgents):
            return task.make_masked_agent_environment(seen, foreign=self.sight == "foreign")
        return task.make_agent_environment(seen, render_mode)

    @property
    def has_mask(self) -> bool:
        """Whether its task can hide from such agents what decides."""
        return isinstance(self._task, TaskWithMaskForAgents)

    def make_policies(self) -> Callable[[int], NetworkPolicy]:
        """Return a function that gives the same policy for each episode."""
        policy = NetworkPolicy(self.trained)
        return lambda _seed: policy

    @property
    def _task(self) -> TaskWithTrainedAgents:
        # Other names could load any code.
        task = find_task(self.task) if self.task in known_tasks() else None
        if isinstance(task, TaskWithTrainedAgents):
            return task
        seen = f"the agent sees {self.trained.manifest.preprocessing!r} of {self.task!r}"
        raise ControllerError(f"{seen}, and no task of this name takes trained agents here")


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
