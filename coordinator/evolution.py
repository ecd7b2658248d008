"""CMA-ES (Hansen 2016) over controller parameters: ask, tell, and a state that continues to the bit."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Literal

import cma
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.coordinator import cma_state
from dreamfleet.coordinator.cma_state import Checkpoint

CMA_VERSION = version("cma")
Covariance = Literal["diagonal", "full"]


@dataclass(frozen=True)
class EvolutionConfig:
    """What makes one strategy: `dimension` parameters, `population` candidates a generation, first step `sigma0`."""

    dimension: int
    population: int
    sigma0: float
    covariance: Covariance
    seed: int

    def __post_init__(self) -> None:
        if self.population < 2:
            raise UsageError(f"population must be at least 2, not {self.population}")
        if not 0 < self.sigma0 < float("inf"):
            raise UsageError(f"sigma0 must be a positive number, not {self.sigma0}")


class Normals:
    """Standard normal samples for pycma from a generator whose state can be written down, ahead where there is time."""

    def __init__(self, seed: int) -> None:
        self._generator = np.random.Generator(np.random.PCG64(seed))
        self._ahead: tuple[dict[str, Any], NDArray[np.float64]] | None = None  # the state before it, and what was drawn

    def __call__(self, *shape: int) -> NDArray[np.float64]:
        """Draw an array of `shape`, as pycma asks for it."""
        if self._ahead is not None and self._ahead[1].shape == shape:
            _, drawn = self._ahead
            self._ahead = None
            return drawn
        self.state = self.state
        return self._generator.standard_normal(shape)

    def draw_ahead(self, *shape: int) -> None:
        """Draw now what is likely asked for next; no number changes by it."""
        if self._ahead is None:
            self._ahead = self.state, self._generator.standard_normal(shape)

    @property
    def state(self) -> dict[str, Any]:
        """The generator's state, as if nothing was drawn ahead."""
        return self._ahead[0] if self._ahead is not None else dict(self._generator.bit_generator.state)

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        self._ahead = None
        self._generator.bit_generator.state = state


class Evolution:
    """Maximises fitness; a checkpoint is taken between tell and ask.

    >>> evolution = Evolution(EvolutionConfig(dimension=3, population=4, sigma0=0.1, covariance="diagonal", seed=1))
    >>> candidates = evolution.ask()
    >>> evolution.tell(np.array([1.0, 2.0, 3.0, 4.0]))
    """

    def __init__(self, config: EvolutionConfig, start: NDArray[np.float64] | None = None) -> None:
        self._config = config
        self._normals = Normals(config.seed)
        self._begin(np.zeros(config.dimension) if start is None else start)
        self._asked: list[NDArray[np.float64]] = []

    def _begin(self, mean: NDArray[np.float64]) -> None:
        self._strategy = cma.CMAEvolutionStrategy(mean, self._config.sigma0, self._options())

    def _options(self) -> dict[str, object]:
        return {
            "popsize": self._config.population,
            "CMA_diagonal": self._config.covariance == "diagonal",
            "seed": np.nan,  # leave NumPy's global source alone: a number here would make continuation inexact
            "randn": self._normals,
            "verbose": -9,
        }

    @property
    def mean(self) -> NDArray[np.float64]:
        """The distribution's mean `(dimension,)`."""
        return np.asarray(self._strategy.mean, dtype=np.float64).copy()

    @property
    def sigma(self) -> float:
        """The overall step size."""
        return float(self._strategy.sigma)

    def ask(self) -> NDArray[np.float64]:
        """The next population `(population, dimension)`."""
        self._asked = [np.asarray(x, dtype=np.float64) for x in self._strategy.ask()]
        return np.stack(self._asked)

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Update the distribution; `fitness` `(population,)`, larger is better, in the order of `ask`."""
        if fitness.shape != (self._config.population,) or not np.isfinite(fitness).all():
            raise ValueError(f"tell needs {self._config.population} finite numbers")  # pycma accepts NaN silently
        self._strategy.tell(self._asked, [-float(value) for value in fitness])
        self._asked = []

    def prepare(self) -> None:
        """Do now what the next `ask` would do, as far as it does not depend on `tell`."""
        self._normals.draw_ahead(self._config.population, self._config.dimension)

    def state(self) -> Checkpoint:
        """Everything that the next `ask` depends on."""
        arrays = cma_state.dump(self._strategy)
        arrays["random"] = np.array(json.dumps(self._normals.state))
        arrays["cma"] = np.array(CMA_VERSION)
        return Checkpoint(arrays)

    def restore(self, state: bytes) -> None:
        """Continue from a packed `state`, written by a strategy of the same configuration and pycma version."""
        arrays = cma_state.unpack(state)
        written = str(arrays.pop("cma"))
        if written != CMA_VERSION:
            raise JournalError(
                f"this run was written with cma {written}: pip install cma=={written} (now {CMA_VERSION})"
            )
        random = json.loads(str(arrays.pop("random")))
        if cma_state.untold(arrays):
            mean, _ = cma_state.mean_and_sigma(arrays)
            self._begin(mean)
        else:
            # pycma builds some of its parts at the first ask and tell; they must be there to be overwritten.
            self.ask()
            self.tell(np.arange(self._config.population, dtype=np.float64))
            cma_state.restore(self._strategy, arrays)
        self._normals.state = random
