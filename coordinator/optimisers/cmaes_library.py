"""What the optimisers from the library `cmaes` have in common: it minimises, and asks for one candidate at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dreamfleet.coordinator.optimisers import cmaes_state
from dreamfleet.coordinator.optimisers.api import Search, State


class CmaesOptimiser(ABC):
    """A strategy of `cmaes` behind the contract of an optimiser."""

    requirement: ClassVar[str] = f"cmaes=={version('cmaes')}"
    options: ClassVar[Mapping[str, str]] = {}
    state_names: ClassVar[tuple[str, ...]]  # the attributes that are its state, without their underscore

    def __init__(self, search: Search) -> None:
        self._search = search
        self._strategy = self._build(search)
        self._asked: list[NDArray[np.float64]] = []

    @abstractmethod
    def _build(self, search: Search) -> Any:
        """The library's own strategy; `UsageError` for what it cannot do."""

    @property
    def mean(self) -> NDArray[np.float64]:
        """The distribution's mean `(dimension,)`."""
        return np.array(self._strategy.mean, dtype=np.float64)

    @property
    def sigma(self) -> float:
        """The step size: the standard deviation of the middle coordinate."""
        covariance = self._strategy._C
        variances = covariance if covariance.ndim == 1 else np.diag(covariance)
        return float(self._strategy._sigma * np.sqrt(np.median(variances)))

    @property
    def axis_ratio(self) -> float | None:
        """The longest axis of the distribution by the shortest; `None` between tell and ask, when no axes are known."""
        covariance = self._strategy._C
        axes = np.sqrt(covariance) if covariance.ndim == 1 else self._strategy._D
        return None if axes is None else float(np.max(axes) / np.min(axes))

    def ask(self) -> NDArray[np.float64]:
        """Sample the next population `(population, dimension)`."""
        self._asked = [self._strategy.ask() for _ in range(self._search.population)]
        return np.stack(self._asked)

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Update the distribution; equal fitness keeps the order of the candidates."""
        self._strategy.tell([(x, -float(value)) for x, value in zip(self._asked, fitness, strict=True)])
        self._asked = []

    def prepare(self) -> None:  # noqa: B027 - not abstract: doing nothing is all there is to do
        """Nothing: the library draws a candidate's normals as it asks for it."""

    def state(self) -> State:
        """What an update reads, and the generator's state."""
        return cmaes_state.dump(self._strategy, self.state_names)

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a `state`."""
        self._strategy = self._build(self._search)
        cmaes_state.restore(self._strategy, self.state_names, state)
