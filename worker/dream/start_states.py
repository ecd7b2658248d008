"""Where dreams start: at first pictures with an empty memory, or at recorded states with the memory of a drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import EIGHT_BITS, INITIAL_LATENTS_PART, RECORDED_STATES, Bundle
from dreamfleet.common.artifacts.onnx_checks import read_float_array
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.printable import plural

Floats = NDArray[np.float32]
START_SPAWN_KEY = (1,)  # gives the choice of a start its own random numbers, apart from those of the dream's steps


class StartState(NamedTuple):
    """A start: `mu` and `logvar` `(latent,)` of the latent, and the model's recurrent state `memory` `(memory,)`."""

    mu: Floats
    logvar: Floats
    memory: Floats


@dataclass(frozen=True)
class StartStates:
    """All start states of a bundle, and the share of dreams that start at recorded states.

    `initial` `(N, 2, latent)` holds mu and logvar of first pictures. `recorded` `(M, 2 * latent + memory)` holds mu,
    logvar and memory at recorded moments. `empty` `(memory,)` is the memory before anything is seen; by default zeros.
    If `doubled`, deviations are computed in double precision, so that hosts of several kinds round them alike.
    """

    initial: Floats
    recorded: Floats
    share: float = 0.0
    empty: Floats | None = None
    doubled: bool = False

    @classmethod
    def of(cls, bundle: Bundle, share: float, empty: Floats) -> StartStates:
        """The start states of a bundle whose model has this `empty` memory; `UsageError` for a share not in [0, 1].

        `BundleError` if the share needs recorded states and there are none, or they belong to another model.
        """
        if not 0 <= share <= 1:
            raise UsageError(f"the share of dreams that start at recorded states must be from 0 to 1, not {share}")
        initial, width = read_float_array(bundle.read(INITIAL_LATENTS_PART)), 2 * bundle.manifest.latent + len(empty)
        doubled = EIGHT_BITS in bundle.manifest.models
        if not share:
            return cls(initial, np.zeros((0, width), dtype=np.float32), empty=empty, doubled=doubled)
        recorded = bundle.read_recorded()
        if recorded.shape[1] != width:
            raise BundleError(
                f"{bundle.path}: a state in {RECORDED_STATES} has {plural(recorded.shape[1], 'number')}, its "
                f"model {width}; "
                "build the bundle again"
            )
        return cls(initial, recorded, share, empty, doubled)

    def choose(self, seed: int, first: int) -> StartState:
        """The start of the dream with this seed: a recorded state, or else the first picture number `first`.

        A seed that starts at a recorded state starts at the same one for every larger share.
        """
        if self.share:
            random = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=START_SPAWN_KEY)))
            if random.random() < self.share:
                return self._recorded(int(random.integers(len(self.recorded))))
        mu, logvar = self.initial[first]
        memory = np.zeros(self.recorded.shape[1] - 2 * len(mu), np.float32) if self.empty is None else self.empty
        return StartState(mu, logvar, memory)

    def deviation(self, logvar: Floats) -> Floats:
        """The standard deviation of a start's latent."""
        half = 0.5 * logvar
        found: Floats = np.exp(half, dtype=np.float64).astype(np.float32) if self.doubled else np.exp(half)
        return found

    def _recorded(self, index: int) -> StartState:
        latent = self.initial.shape[2]
        mu, logvar, memory = np.split(self.recorded[index], [latent, 2 * latent])
        return StartState(mu, logvar, memory)
