"""What a host computes on fixed inputs: two hosts are of one class if they compute the same bits here.

A short episode goes through everything that a fitness is made of: the simulator and its picture, the policy with its
world model, and for tasks that score in batches, such as the dream, these too. Every number that is met on the way is
looked at, not only the scores: kernels that round otherwise show in the last bits of nearly any sum of products. It is
a sample all the same: what differs in rarer inputs alone is not seen.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.scoring.watched_policy import WatchedPolicy
from dreamfleet.worker.tasks.api import Batch, Policy, StepSnapshot, WatchableBatch

SEED = 0  # nobody's
PROBE_CONTROLLERS = 4  # that are shown what the first one saw
MAX_PARAMETER = 0.25  # parameter of the controllers: their actions are neither all alike nor all at a bound


class HostClassProbe:
    """The digest of what was computed so far; as a `StepObserver` it adds each step."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    @property
    def host_class(self) -> str:
        """The class that these bits make."""
        return self._hash.hexdigest()[:16]

    def add_episode(self, environment: gymnasium.Env[Any, Any], policy: Policy, size: int, steps: int) -> None:
        """Take in an episode of a controller of `size` parameters, of so many steps at most.

        What was observed there is shown to other controllers too.
        """
        parameters, seen = fixed_parameters(size), []
        watched = WatchedPolicy(policy, self, 0)  # with what a world model has in mind
        watched.begin(parameters)
        for moment in run_episode(environment, watched, EpisodeConfig(SEED, steps)):
            seen.append(moment.seen)
            self.add_value((moment.seen, moment.reward, moment.ended))
        outputs: Callable[[Any], Any] = getattr(policy, "outputs", policy.act)  # of a `PolicyWithOutputs` one
        for shift in range(PROBE_CONTROLLERS):
            policy.begin(np.roll(parameters, shift))
            for each in seen:
                self.add_value(outputs(each))

    def add_batch(self, batch: Batch, size: int) -> None:
        """Take in what a batch makes of two controllers of `size` parameters, and what it shows of its steps."""
        shown = batch.watched(self) if isinstance(batch, WatchableBatch) else batch
        episodes = [(fixed_parameters(size), SEED), (-fixed_parameters(size), SEED)]
        for each in shown.score(episodes, lambda _: None):
            self.add_value((float(each.fitness), int(each.steps)))

    def due(self) -> bool:
        """Every step is looked at."""
        return True

    def see(self, episode: int, look: Callable[[], StepSnapshot]) -> None:  # noqa: ARG002 - as an onlooker is shown it
        """Take in a step of a batch."""
        self.add_value(tuple(look()))

    def add_value(self, value: Any) -> None:
        """Take in the bits of what an environment or a policy gives, whatever it is made of."""
        if isinstance(value, Mapping):
            for name in sorted(value, key=str):
                self.add_value((str(name), value[name]))
        elif isinstance(value, (tuple, list)):
            for each in value:
                self.add_value(each)
        elif isinstance(value, (np.ndarray, np.generic)) and value.dtype != object:
            self._hash.update(f"{value.dtype.str} {value.shape}".encode() + np.ascontiguousarray(value).tobytes())
        elif value is None or isinstance(value, (bool, int, float, str, bytes)):
            self._hash.update(f"{type(value).__name__} {value!r}".encode())  # a float's text is exact


def fixed_parameters(size: int) -> NDArray[np.float32]:
    """Parameters `(size,)` of the probing controllers: spread evenly by whole numbers, the same bits on every host."""
    spread = np.arange(1, size + 1, dtype=np.uint64) * np.uint64(2654435769) % np.uint64(2**32)  # Knuth's 2^32 / phi
    centred: NDArray[np.float32] = ((spread.astype(np.float64) / 2**31 - 1) * MAX_PARAMETER).astype(np.float32)
    return centred
