"""The interface of an optimiser: it proposes candidates, learns from their fitness, and resumes to the bit.

The only module that a third party imports. Register a class under the entry-point group `dreamfleet.optimisers`, or
name it as `module:attribute`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.measures import Axis

State = dict[str, NDArray[Any]]
"""Named arrays of numbers or text, never of objects; names that begin with `optimiser.` belong to the coordinator."""


@dataclass(frozen=True)
class Search:
    """What an optimiser is built from.

    `mean` `(dimension,)` is where it begins, `sigma0` its first step size, `population` the candidates that every `ask`
    returns, `seed` a number of at least 0 from which all its randomness follows, and `options` what the user gave.
    `archive` are the axes of the run's archive; empty if the run measures nothing beside fitness.

    >>> search = Search(mean=np.zeros(3), population=8, sigma0=0.5, seed=1, options={"covariance": "full"})
    >>> search.dimension, search.choice("covariance", "diagonal", "full")
    (3, 'full')
    """

    mean: NDArray[np.float64]
    population: int
    sigma0: float
    seed: int
    options: Mapping[str, str] = field(default_factory=dict)
    archive: tuple[Axis, ...] = ()

    @property
    def dimension(self) -> int:
        """Parameters of a candidate."""
        return len(self.mean)

    def choice(self, option: str, *known: str) -> str:
        """The option's value, the first of `known` where it was not given; `UsageError` for any other."""
        value = self.options.get(option, known[0])
        if value not in known:
            raise UsageError(f"option {option} must be one of {', '.join(known)}, not {value!r}")
        return value


@dataclass(frozen=True)
class Footprint:
    """Bytes that an optimiser needs: at its peak in memory, and of its state in the journal.

    >>> Footprint(memory=8 * 10**9, state=10**9).state
    1000000000
    """

    memory: int
    state: int


class Optimiser(Protocol):
    """Maximises fitness. The coordinator calls `ask` and `tell` in turn, and `state` only after `tell`.

    `requirement` is what pip installs to get these very bits, such as "cma==4.5.0". A state names it, and is continued
    by the same one alone. `options` says which options there are, and what each takes.

    Four more attributes are optional. `axis_ratio`, a float, is shown: how many times longer the longest axis of the
    distribution is than the shortest. `redraw(indices)` is needed by `--on-failure redraw`: it replaces candidates of
    the last `ask`, which failed, and returns the new ones `(len(indices), dimension)`. `tell` then refers to these. A
    candidate that was not drawn at random may stay as it is. The result must not depend on `prepare`.
    `takes_measures`, a class attribute that is true, says that `tell(fitness, measures)` also takes measures
    `(population, axes)`: one for each axis of the search's archive, NaN for a candidate that failed.
    `footprint(dimension, population, options)`, a class method, returns a `Footprint`, so that a search which this
    host cannot hold is refused before it is built.

    >>> from dreamfleet.coordinator.addons.optimisers.cmaes_library import Separable
    >>> optimiser: Optimiser = Separable(Search(mean=np.zeros(3), population=8, sigma0=0.5, seed=1))
    >>> for _ in range(100):
    ...     optimiser.tell(-np.square(optimiser.ask() - 1).sum(axis=1))
    >>> optimiser.mean.round(3)
    array([1., 1., 1.])
    """

    requirement: ClassVar[str]
    options: ClassVar[Mapping[str, str]]

    def __init__(self, search: Search) -> None:
        """Begin; `UsageError` for what this optimiser cannot do, before a run exists."""

    @property
    def mean(self) -> NDArray[np.float64]:
        """The best guess `(dimension,)`: what is evaluated and reported, and where a fork begins."""

    @property
    def sigma(self) -> float:
        """The overall step size: what is shown, and what a fork begins with."""

    def ask(self) -> NDArray[np.float64]:
        """The next population `(population, dimension)`; every number is finite."""

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Learn from the population asked for: `fitness` `(population,)` in its order, finite, larger is better."""

    def prepare(self) -> None:
        """Work ahead while workers are busy, if there is anything to do; called any number of times, changes no bit."""

    def state(self) -> State:
        """Everything that the next `ask` and all that follows depend on; arrays that nobody changes later."""

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from what `state` gave to an optimiser of an equal `Search`, but for its `mean`."""
