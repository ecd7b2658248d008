"""Optimisers from the library `cmaes`: separable CMA-ES, CMA-ES that adapts its learning rates, and xNES.

The library minimises, and samples one candidate at a time. It offers pickle for its state, and drops the random
generator from it. We store the attributes that an update reads, which each class names, and the generator. The
constructor derives the others from its arguments. The library's history of fitness is not stored: only its
termination criteria read it, and its first values are uninitialised memory.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.packages import hidden
from dreamfleet.coordinator.optimisers.api import Footprint, Search, State
from dreamfleet.coordinator.optimisers.checkpoint import tag, untag

with hidden("scipy"):  # which only other strategies of the library use; importing it takes a second
    import cmaes


def _seed_of(search: Search) -> int:
    """The library takes 32 bits: a larger seed is folded."""
    return search.seed % 2**32


class CmaesOptimiser(ABC):
    """A strategy of the library as an `Optimiser`."""

    requirement: ClassVar[str] = f"cmaes=={version('cmaes')}"
    options: ClassVar[Mapping[str, str]] = {}
    state_names: ClassVar[tuple[str, ...]]  # of the attributes, without their underscore

    def __init__(self, search: Search) -> None:
        self._search = search
        self._strategy = self._build(search)
        self._asked: list[NDArray[np.float64]] = []

    @abstractmethod
    def _build(self, search: Search) -> Any:
        """The library's own strategy; `UsageError` for a search that it cannot do."""

    @property
    def mean(self) -> NDArray[np.float64]:
        """The distribution's mean `(dimension,)`."""
        return np.array(self._strategy._mean, dtype=np.float64)

    @property
    def sigma(self) -> float:
        """The step size: the standard deviation of the middle coordinate."""
        covariance = self._strategy._C
        variances = covariance if covariance.ndim == 1 else np.diag(covariance)
        return float(self._strategy._sigma * np.sqrt(np.median(variances)))

    @property
    def axis_ratio(self) -> float | None:
        """The longest axis of the distribution by the shortest; `None` between an update and the next `ask`."""
        covariance = self._strategy._C
        axes = np.sqrt(covariance) if covariance.ndim == 1 else self._strategy._D
        return None if axes is None else float(np.max(axes) / np.min(axes))

    def ask(self) -> NDArray[np.float64]:
        """Sample the next population `(population, dimension)`."""
        self._asked = self._draw(self._search.population)
        return np.stack(self._asked)

    def redraw(self, indices: Sequence[int]) -> NDArray[np.float64]:
        """Sample these candidates again."""
        drawn = self._draw(len(indices))
        for index, candidate in zip(indices, drawn, strict=True):
            self._asked[index] = candidate
        return np.stack(drawn)

    def _draw(self, count: int) -> list[NDArray[np.float64]]:
        return [self._strategy.ask() for _ in range(count)]

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Update the distribution; equal fitness keeps the order of the candidates."""
        self._strategy.tell([(x, -float(value)) for x, value in zip(self._asked, fitness, strict=True)])
        self._asked = []

    def prepare(self) -> None:  # noqa: B027 - not abstract: doing nothing is all there is to do
        """Do nothing: the library draws the normals of each candidate in `ask`."""

    def state(self) -> State:
        """The attributes that `state_names` lists, and the generator's state."""
        arrays: State = {}
        scalars: dict[str, list[Any]] = {}
        for name in self.state_names:
            value = getattr(self._strategy, f"_{name}")
            if isinstance(value, np.ndarray):
                arrays[name] = value.copy()
            else:
                scalars[name] = tag(value)
        random = self._strategy._rng.get_state(legacy=False)
        arrays["random.key"] = random["state"].pop("key").copy()
        random["gauss"] = tag(random["gauss"])
        arrays["scalars"] = np.array(json.dumps(scalars, sort_keys=True))
        arrays["random"] = np.array(json.dumps(random, sort_keys=True))
        return arrays

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a `state`; `KeyError` if an attribute is missing."""
        self._strategy = self._build(self._search)
        scalars = json.loads(str(state["scalars"]))
        for name in self.state_names:
            setattr(self._strategy, f"_{name}", untag(scalars[name]) if name in scalars else state[name].copy())
        random = json.loads(str(state["random"]))
        random["state"]["key"] = state["random.key"]
        random["gauss"] = untag(random["gauss"])
        self._strategy._rng.set_state(random)


class Separable(CmaesOptimiser):
    """CMA-ES over the diagonal of the covariance matrix, in linear time and space (Ros and Hansen 2008, sep-CMA-ES).

    The covariance learns (n + 2) / 3 times as fast as the full matrix would. The step size follows the evolution path
    whatever the dimension (Hansen 2016, arXiv:1604.00772, equations 43 and 44), unlike in pycma's diagonal model.

    >>> optimiser = Separable(Search(mean=np.zeros(3), population=4, sigma0=0.1, seed=1))
    >>> candidates = optimiser.ask()
    >>> optimiser.tell(-np.square(candidates - 1).sum(axis=1))
    """

    state_names: ClassVar[tuple[str, ...]] = ("mean", "sigma", "C", "p_sigma", "pc", "g")

    def _build(self, search: Search) -> Any:
        if search.dimension < 2:
            raise UsageError("cmaes-sep needs at least 2 parameters: give --optimiser cma")
        return cmaes.SepCMA(search.mean.copy(), search.sigma0, seed=_seed_of(search), population_size=search.population)


class RateAdapted(CmaesOptimiser):
    """CMA-ES that keeps the signal-to-noise ratio of its updates constant (Nomura et al. 2023, arXiv:2304.03473).

    Mean and covariance are updated as by Hansen 2016 (arXiv:1604.00772, equations 38 to 47), then each step is
    shortened by a learning rate of its own, at most 1, so that noise or many optima slow it down instead of leading it
    astray at the default population. It holds the full matrix: cost and state grow with the square of the parameters
    and more, see `docs/reference/optimisers.md`.

    >>> optimiser = RateAdapted(Search(mean=np.zeros(3), population=4, sigma0=0.1, seed=1))
    >>> candidates = optimiser.ask()
    >>> optimiser.tell(-np.square(candidates - 1).sum(axis=1))
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "mean", "sigma", "C", "p_sigma", "pc", "g", "Emean", "ESigma", "Vmean", "VSigma", "eta_mean", "eta_Sigma",
    )  # fmt: skip

    @classmethod
    def footprint(cls, dimension: int, population: int, options: Mapping[str, str]) -> Footprint:  # noqa: ARG003
        """As measured: in an update two square matrices for each candidate and 18 more, of which two are state."""
        return Footprint(8 * (2 * population + 18) * dimension**2, 8 * 2 * dimension**2)

    def _draw(self, count: int) -> list[NDArray[np.float64]]:
        """Sample candidates (equations 38 to 40 of Hansen 2016).

        The library's own `ask` multiplies B with D as two full matrices anew for each candidate; these are its bits.
        """
        strategy = self._strategy
        eigenvectors, roots = strategy._eigen_decomposition()
        axes = np.ascontiguousarray(eigenvectors * roots)
        normals = (strategy._rng.randn(self._search.dimension) for _ in range(count))
        return [strategy._mean + strategy._sigma * axes.dot(z) for z in normals]

    def _build(self, search: Search) -> Any:
        if search.population < 4:
            # Below 4 a single parent is selected: mu_eff is 1, and so the rate of the rank-mu update 0 (equation 58).
            raise UsageError(f"cmaes-lra needs a population of at least 4, not {search.population}: give --population")
        return cmaes.CMA(
            search.mean.copy(), search.sigma0, seed=_seed_of(search), population_size=search.population, lr_adapt=True
        )


class ExponentialNes(CmaesOptimiser):
    """xNES (Glasmachers et al. 2010): natural gradients of mean, step size and the full matrix of axes.

    >>> optimiser = ExponentialNes(Search(mean=np.zeros(3), population=8, sigma0=0.1, seed=1))
    >>> candidates = optimiser.ask()
    >>> optimiser.tell(-np.square(candidates - 1).sum(axis=1))
    """

    state_names: ClassVar[tuple[str, ...]] = ("mean", "sigma", "B", "g")

    @classmethod
    def footprint(cls, dimension: int, population: int, options: Mapping[str, str]) -> Footprint:  # noqa: ARG003
        """As measured: in an update two square matrices for each candidate and 8 more, of which one is state."""
        return Footprint(8 * (2 * population + 8) * dimension**2, 8 * dimension**2)

    @property
    def sigma(self) -> float:
        """The step size: the standard deviation of the middle coordinate."""
        variances = np.square(self._strategy._B).sum(axis=1)
        return float(self._strategy._sigma * np.sqrt(np.median(variances)))

    @property
    def axis_ratio(self) -> float:
        """The longest axis of the distribution by the shortest."""
        return float(np.linalg.cond(self._strategy._B))

    def _build(self, search: Search) -> Any:
        if search.dimension < 2:
            raise UsageError("xnes needs at least 2 parameters: give --optimiser cma")
        return cmaes.XNES(search.mean.copy(), search.sigma0, seed=_seed_of(search), population_size=search.population)
