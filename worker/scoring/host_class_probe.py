"""The class of a host: two hosts are of one class if they compute the same bits on fixed inputs.

A short episode uses everything that a fitness depends on: the simulator and its picture, the policy with its world
model, and the batch of tasks such as the dream. All numbers on the way are hashed, not only the scores, because another
rounding shows in the last bits of nearly any sum of products. It remains a sample: rarer differences are not found.
Other inputs or other digits are another class of every host: a run goes on in its own (upgrade.md, tests of joining).
A host whose second probe computes other bits than its first one has the class `NON_DETERMINISTIC`.
"""

import hashlib
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.scoring.watched_policy import WatchedPolicy
from dreamfleet.worker.tasks.api import Policy
from dreamfleet.worker.tasks.batches import Batch, WatchableBatch
from dreamfleet.worker.tasks.watching import StepSnapshot

SEED = 0  # used by no run
REPEAT_LIMIT = 10.0  # seconds of the first probe from which on it is not repeated: a child must be ready in time
PROBE_CONTROLLERS = 4  # controllers that get the observations of the first one's episode
MAX_PARAMETER = 0.25  # small enough that the actions differ and are not all at a bound


class HostClassProbe:
    """A digest of everything computed so far. As a `StepObserver` it adds every step."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    @property
    def host_class(self) -> str:
        """The host class: the first 16 hex digits of the digest."""
        return self._hash.hexdigest()[:16]

    def add_episode(self, environment: gymnasium.Env[Any, Any], policy: Policy, size: int, steps: int) -> None:
        """Add an episode of at most `steps` steps of a controller with `size` parameters.

        Other controllers' outputs for the same observations are added too.
        """
        parameters, seen = fixed_parameters(size), []
        inner = getattr(environment, "unwrapped", None)
        if getattr(inner, "fuses_products", False):  # it shows in pictures after the probe's last step
            self.add_value("fused products")
        watched = WatchedPolicy(policy, self, 0)  # it also passes the world model's latent and state to `observe`
        watched.begin(parameters)
        for moment in run_episode(environment, watched, EpisodeConfig(SEED, steps)):
            seen.append(moment.seen)
            self.add_value((moment.seen, moment.reward, moment.ended))
        outputs: Callable[[Any], Any] = getattr(policy, "outputs", policy.act)  # `Policy` describes it
        for shift in range(PROBE_CONTROLLERS):
            policy.begin(np.roll(parameters, shift))
            for each in seen:
                self.add_value(outputs(each))

    def add_batch(self, batch: Batch, size: int) -> None:
        """Add the scores of two controllers with `size` parameters in a batch, and the steps that the batch shows."""
        shown = batch.watched(self) if isinstance(batch, WatchableBatch) else batch
        episodes = [(fixed_parameters(size), SEED), (-fixed_parameters(size), SEED)]
        for each in shown.score(episodes, lambda _: None):
            self.add_value((float(each.fitness), int(each.steps)))

    def is_due(self) -> bool:
        """Observe every step."""
        return True

    def observe(self, episode: int, look: Callable[[], StepSnapshot]) -> None:  # noqa: ARG002 - of the protocol
        """Add a step."""
        self.add_value(tuple(look()))

    def add_value(self, value: Any) -> None:
        """Add the bits of a value of an environment or a policy: numbers, arrays, texts, and containers of them."""
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
    """Parameters `(size,)` of the controllers, spread evenly by integer arithmetic: the same bits on every host."""
    spread = np.arange(1, size + 1, dtype=np.uint64) * np.uint64(2654435769) % np.uint64(2**32)  # Knuth's 2^32 / phi
    centred: NDArray[np.float32] = ((spread.astype(np.float64) / 2**31 - 1) * MAX_PARAMETER).astype(np.float32)
    return centred
