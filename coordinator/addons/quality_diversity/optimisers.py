"""Quality-diversity by the library pyribs: the best candidate of each kind of behaviour, in a grid archive.

pyribs offers pickle for its state. We keep what decides its next question: the elites in the order in which their cells
were found, each emitter's distribution, and the states of all random generators. A restored archive gets its elites
through the library's own `add_single`, in that order, so that drawing an elite by chance draws the same one.

The library would compile parts of an update with Numba, which takes up to a minute and makes other bits. They are plain
NumPy, and no slower as that, so we load the library with compiling turned off.
"""

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from operator import attrgetter
from typing import Any, ClassVar

import numba
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.packages import hidden
from dreamfleet.coordinator.optimisers.api import Footprint, Search, State
from dreamfleet.coordinator.optimisers.checkpoint import tag, untag


@contextmanager
def _without_compiling() -> Iterator[None]:
    """Functions that are defined inside stay Python, whatever Numba is configured to do."""
    config: Any = numba.config
    before, config.DISABLE_JIT = config.DISABLE_JIT, True
    try:
        yield
    finally:
        config.DISABLE_JIT = before


with _without_compiling(), hidden("torch"):  # which the library only checks types with; importing it takes seconds
    from ribs.archives import GridArchive
    from ribs.emitters import EvolutionStrategyEmitter, GaussianEmitter

CANDIDATES = 16  # of an emitter, as CMA-ES' default for a few dozen parameters
LARGEST_ARCHIVE = 5 * 10**8  # bytes of its elites' parameters
# Of an emitter's evolution strategy, by the kind of its covariance matrix.
_DIAGONAL = ("mean", "pc", "ps", "cov.cov")
_ARRAYS = {"diagonal": _DIAGONAL, "full": (*_DIAGONAL, "cov.eigenbasis", "cov.eigenvalues", "cov.invsqrt")}
_SCALARS = {
    "diagonal": ("current_eval", "sigma"),
    "full": ("current_eval", "sigma", "cov.condition_number", "cov.updated_eval"),
}


class RibsOptimiser(ABC):
    """An archive of elites and emitters that ask for candidates: each emitter for a part of the population.

    Its `mean` is the best elite, which is evaluated, reported and forked from. A candidate that failed never enters the
    archive, and ranks last.
    """

    requirement: ClassVar[str] = f"ribs=={version('ribs')}"
    options: ClassVar[Mapping[str, str]] = {}
    takes_measures: ClassVar[bool] = True
    _emitter_count = 1

    def __init__(self, search: Search) -> None:
        if not search.archive:
            raise UsageError("give the axes of its archive, such as --archive steps=0:500:20 brake.share=0:1:20")
        cells = math.prod(axis.cells for axis in search.archive)
        if (size := cells * search.dimension * 8) > LARGEST_ARCHIVE:
            raise UsageError(
                f"an archive of {cells:,} cells of {search.dimension:,} parameters holds {size / 1e9:.1f} GB, "
                f"{LARGEST_ARCHIVE / 1e9:.1f} at most: give --archive fewer cells"
            )
        self._search = search
        self._asked = np.zeros((0, search.dimension))
        self._build()

    def _build(self) -> None:
        search = self._search
        seeds: list[Any] = np.random.SeedSequence(search.seed).spawn(1 + self._emitter_count)
        self._archive: Any = GridArchive(
            solution_dim=search.dimension,
            dims=[axis.cells for axis in search.archive],
            ranges=[(axis.low, axis.high) for axis in search.archive],
            seed=seeds.pop(0),
        )
        shares = np.array_split(np.arange(search.population), self._emitter_count)
        self._emitters = [self._emitter(len(share), seed) for share, seed in zip(shares, seeds, strict=True)]

    @abstractmethod
    def _emitter(self, candidates: int, seed: Any) -> Any:
        """A new emitter that asks for so many candidates."""

    @abstractmethod
    def _emitter_state(self, emitter: Any) -> State:
        """What decides an emitter's next question, but for the archive."""

    @abstractmethod
    def _restore_emitter(self, emitter: Any, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from what `_emitter_state` gave."""

    @property
    def mean(self) -> NDArray[np.float64]:
        """The parameters of the best elite `(dimension,)`; the first mean while the archive is empty."""
        if self._archive.empty:
            return self._search.mean
        elites = self._archive.data()
        best: NDArray[np.float64] = elites["solution"][np.argmax(elites["objective"])]
        return best

    def ask(self) -> NDArray[np.float64]:
        """The emitters' candidates `(population, dimension)`."""
        self._asked = np.concatenate([np.array(emitter.ask()) for emitter in self._emitters])
        return self._asked.copy()

    def tell(self, fitness: NDArray[np.float64], measures: NDArray[np.float64]) -> None:
        """Put candidates into the archive, and tell each emitter which of its own came in.

        `measures` `(population, axes)` outside an axis' range count as at its end; NaN for a candidate that failed.
        """
        low, high = (np.array([getattr(axis, end) for axis in self._search.archive]) for end in ("low", "high"))
        scored: NDArray[np.bool_] = np.asarray(np.isfinite(measures).all(axis=1))
        inside = np.where(scored[:, None], np.clip(measures, low, high), low)
        status, value = np.zeros(len(fitness), np.int32), np.zeros(len(fitness))
        if scored.any():
            found = self._archive.add(self._asked[scored], fitness[scored], inside[scored])
            status[scored], value[scored] = found["status"], found["value"]
            value[~scored] = value[scored].min() - 1
        start = 0
        for emitter in self._emitters:
            own = slice(start, start := start + emitter.batch_size)
            if not self._archive.empty:  # an emitter that starts anew draws an elite
                added = {"status": status[own], "value": value[own]}
                emitter.tell(self._asked[own], fitness[own], inside[own], added)

    def prepare(self) -> None:  # noqa: B027 - not abstract: doing nothing is all there is to do
        """Do nothing: an emitter's question depends on the archive."""

    def state(self) -> State:
        """The archive in the order in which its cells were found, the emitters, and the random generators."""
        elites = self._archive.data()
        arrays: State = {f"archive.{name}": elites[name].copy() for name in ("solution", "objective", "measures")}
        arrays["archive.random"] = _random_state(self._archive._rng)
        arrays["start"] = self._search.mean.copy()
        for number, emitter in enumerate(self._emitters):
            arrays |= {f"emitter.{number}.{name}": each for name, each in self._emitter_state(emitter).items()}
        return arrays

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a `state`; `KeyError` if a part is missing."""
        self._search = replace(self._search, mean=state["start"].astype(np.float64))
        self._build()
        elites = [state[f"archive.{name}"] for name in ("solution", "objective", "measures")]
        for elite in zip(*elites, strict=True):
            self._archive.add_single(*elite)
        _set_random_state(self._archive._rng, state["archive.random"])
        for number, emitter in enumerate(self._emitters):
            prefix = f"emitter.{number}."
            own = {name.removeprefix(prefix): each for name, each in state.items() if name.startswith(prefix)}
            self._restore_emitter(emitter, own)


class MapElites(RibsOptimiser):
    """MAP-Elites (Mouret and Clune 2015, arXiv:1504.04909): each candidate is an elite, drawn by chance, with noise.

    The noise has the search's first step size, and keeps it.

    >>> from dreamfleet.common.protocol.measures import Axis
    >>> axes = (Axis("x", -1, 1, 4), Axis("y", -1, 1, 4))
    >>> optimiser = MapElites(Search(mean=np.zeros(3), population=8, sigma0=0.5, seed=1, archive=axes))
    >>> for _ in range(20):
    ...     asked = optimiser.ask()
    ...     optimiser.tell(-np.square(asked).sum(axis=1), asked[:, :2])
    >>> len(optimiser.state()["archive.objective"])
    16
    """

    @property
    def sigma(self) -> float:
        """The deviation of the noise."""
        return self._search.sigma0

    def _emitter(self, candidates: int, seed: Any) -> Any:
        search = self._search
        return GaussianEmitter(self._archive, sigma=search.sigma0, x0=search.mean, batch_size=candidates, seed=seed)

    def _emitter_state(self, emitter: Any) -> State:
        return {"random": _random_state(emitter._rng)}

    def _restore_emitter(self, emitter: Any, state: Mapping[str, NDArray[Any]]) -> None:
        _set_random_state(emitter._rng, state["random"])


class CmaMe(RibsOptimiser):
    """CMA-ME (Fontaine et al. 2020, arXiv:1912.02400): CMA-ES that climbs towards what improves the archive.

    An improvement emitter ranks candidates that found a new cell above those that improved one, and those by how much.
    It begins again at an elite, drawn by chance, when none of its candidates came in.
    """

    options: ClassVar[Mapping[str, str]] = {
        "covariance": "diagonal or full",
        "emitters": f"how many distributions share the population (default one for each {CANDIDATES} candidates)",
    }

    def __init__(self, search: Search) -> None:
        self._covariance = search.choice("covariance", "diagonal", "full")
        self._emitter_count = _emitters(search)
        super().__init__(search)

    @classmethod
    def footprint(cls, dimension: int, population: int, options: Mapping[str, str]) -> Footprint | None:
        """A full matrix of each emitter is kept four times, and updated in as many."""
        if options.get("covariance") != "full":
            return Footprint(memory=0, state=0)
        count = _emitters(Search(np.zeros(1), population, 1.0, 0, options))
        matrix = 8 * dimension**2
        return Footprint(memory=(4 * count + 4) * matrix, state=3 * count * matrix)

    @property
    def sigma(self) -> float:
        """The mean of the emitters' step sizes."""
        return float(np.mean([emitter._opt.sigma for emitter in self._emitters]))

    def _emitter(self, candidates: int, seed: Any) -> Any:
        search, kind = self._search, "cma_es" if self._covariance == "full" else "sep_cma_es"
        return EvolutionStrategyEmitter(
            self._archive, x0=search.mean, sigma0=search.sigma0, ranker="2imp", es=kind, batch_size=candidates,
            seed=seed,
        )  # fmt: skip

    def _emitter_state(self, emitter: Any) -> State:
        strategy = emitter._opt
        arrays: State = {name: attrgetter(name)(strategy).copy() for name in _ARRAYS[self._covariance]}
        scalars = {name: tag(attrgetter(name)(strategy)) for name in _SCALARS[self._covariance]}
        scalars |= {"restarts": tag(emitter._restarts), "itrs": tag(emitter._itrs)}
        arrays["scalars"] = np.array(json.dumps(scalars, sort_keys=True))
        arrays["random"] = _random_state(strategy._rng)
        return arrays

    def _restore_emitter(self, emitter: Any, state: Mapping[str, NDArray[Any]]) -> None:
        strategy, scalars = emitter._opt, json.loads(str(state["scalars"]))
        found = {name: state[name].copy() for name in _ARRAYS[self._covariance]}
        found |= {name: untag(scalars[name]) for name in _SCALARS[self._covariance]}
        for name, value in found.items():
            setattr(strategy.cov if name.startswith("cov.") else strategy, name.removeprefix("cov."), value)
        emitter._restarts, emitter._itrs = untag(scalars["restarts"]), untag(scalars["itrs"])
        _set_random_state(strategy._rng, state["random"])


def _emitters(search: Search) -> int:
    """How many emitters the options ask for; `UsageError` if each would have fewer than two candidates."""
    text = search.options.get("emitters", str(max(1, search.population // CANDIDATES)))
    if not text.isdecimal() or not 1 <= int(text) <= search.population // 2:
        raise UsageError(f"option emitters must be from 1 to {search.population // 2}, half the population, not {text}")
    return int(text)


def _random_state(generator: np.random.Generator) -> NDArray[Any]:
    return np.array(json.dumps(generator.bit_generator.state))


def _set_random_state(generator: np.random.Generator, state: NDArray[Any]) -> None:
    generator.bit_generator.state = json.loads(str(state))
