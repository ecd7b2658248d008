"""Evolution strategies that follow a search gradient: OpenAI-ES, PEPG and SNES.

A population of a normal distribution estimates the gradient of the expected fitness by the distribution's parameters.
Fitness counts by its rank alone. No step needs BLAS, so bits do not depend on how a product is split.
"""

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.optimisers.api import Search, State

Floats = NDArray[np.float64]
FIRST_MOMENT, SECOND_MOMENT, SMALLEST_DIVISOR = 0.9, 0.999, 1e-8  # of Adam (Kingma and Ba 2015, arXiv:1412.6980)
RATE = "learning rate of the mean, by default a tenth of sigma0"


class SearchGradient(ABC):
    """A normal distribution with a deviation for each parameter, and its update by ranked samples."""

    requirement: ClassVar[str] = "dreamfleet.search_gradients==1"  # raised whenever an equal search asks for other bits
    options: ClassVar[Mapping[str, str]] = {}
    mirrored: ClassVar[bool]  # whether each sample is drawn with its mirror image; an odd one out is the mean

    def __init__(self, search: Search) -> None:
        self._search = search
        self._random = np.random.Generator(np.random.PCG64(search.seed))
        self._mean = np.array(search.mean, dtype=np.float64)
        self._deviations = np.full(search.dimension, float(search.sigma0))
        self._samples = np.zeros((search.population, search.dimension))  # of the open population, in deviations
        self._begin()

    def _begin(self) -> None:  # noqa: B027 - not abstract: most have nothing more to begin with
        """Read options, and set what more is adapted."""

    @property
    def mean(self) -> Floats:
        """The distribution's mean `(dimension,)`."""
        return self._mean.copy()

    @property
    def sigma(self) -> float:
        """The deviation of the middle parameter."""
        return float(np.median(self._deviations))

    @property
    def axis_ratio(self) -> float:
        """The largest deviation by the smallest."""
        return float(self._deviations.max() / self._deviations.min())

    def ask(self) -> Floats:
        """Sample the next population `(population, dimension)`."""
        population, dimension = self._samples.shape
        if self.mirrored:
            half = self._random.standard_normal((population // 2, dimension))
            self._samples = np.concatenate([half, -half, np.zeros((population % 2, dimension))])
        else:
            self._samples = self._random.standard_normal((population, dimension))
        return self._mean + self._deviations * self._samples

    def redraw(self, indices: Sequence[int]) -> Floats:
        """Sample these candidates again, each without a mirror image."""
        drawn = self._random.standard_normal((len(indices), self._search.dimension))
        self._samples[list(indices)] = drawn
        return self._mean + self._deviations * drawn

    @abstractmethod
    def tell(self, fitness: Floats) -> None:
        """Update mean and deviations by the ranks of the open samples' `fitness` `(population,)`."""

    def prepare(self) -> None:  # noqa: B027 - not abstract: doing nothing is all there is to do
        """Do nothing: samples are drawn in `ask`."""

    def state(self) -> State:
        """What the updates change, and the generator's state."""
        random = json.dumps(self._random.bit_generator.state)
        return {"mean": self._mean.copy(), "deviations": self._deviations.copy(), "random": np.array(random)}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a `state`; `ValueError` for one of another dimension."""
        self._mean, self._deviations = (self._read(state, name) for name in ("mean", "deviations"))
        self._random.bit_generator.state = json.loads(str(state["random"]))

    def _read(self, state: Mapping[str, NDArray[Any]], name: str) -> Floats:
        found = np.array(state[name], dtype=np.float64)
        if found.shape != (self._search.dimension,):
            raise ValueError(f"{name} has shape {found.shape}")
        return found

    def _number(self, option: str, default: float, most: float = math.inf) -> float:
        """The option as a number above 0, `most` at most; `UsageError` else."""
        text = self._search.options.get(option)
        try:
            value = default if text is None else float(text)
        except ValueError:
            value = math.nan
        if not (0 < value <= most and math.isfinite(value)):
            limit = "" if math.isinf(most) else f" and at most {most:g}"
            raise UsageError(f"option {option} must be a number above 0{limit}, not {text!r}")
        return value


class _AdamMean(SearchGradient):
    """A search gradient whose mean moves by Adam; `learning_rate` is its largest step, nearly."""

    mirrored = True

    def _begin(self) -> None:
        self._rate = self._number("learning_rate", self._search.sigma0 / 10)
        self._first, self._second = np.zeros(self._search.dimension), np.zeros(self._search.dimension)
        self._updates = 0

    def _climb(self, gradient: Floats) -> None:
        """Move the mean along a gradient `(dimension,)` (Kingma and Ba 2015, algorithm 1)."""
        self._updates += 1
        self._first = FIRST_MOMENT * self._first + (1 - FIRST_MOMENT) * gradient
        self._second = SECOND_MOMENT * self._second + (1 - SECOND_MOMENT) * gradient**2
        first = self._first / (1 - FIRST_MOMENT**self._updates)
        second = self._second / (1 - SECOND_MOMENT**self._updates)
        self._mean = self._mean + self._rate * first / (np.sqrt(second) + SMALLEST_DIVISOR)

    def state(self) -> State:
        """As of any search gradient, with Adam's moments."""
        own = {"first": self._first.copy(), "second": self._second.copy(), "updates": np.array(self._updates)}
        return {**super().state(), **own}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a `state`."""
        super().restore(state)
        self._first, self._second = (self._read(state, name) for name in ("first", "second"))
        self._updates = int(state["updates"])


class OpenES(_AdamMean):
    """OpenAI's evolution strategy (Salimans et al. 2017, arXiv:1703.03864): a constant deviation, and Adam.

    Samples come in mirrored pairs, and their ranks are scaled to the range from -0.5 to 0.5.

    >>> optimiser = OpenES(Search(mean=np.zeros(3), population=8, sigma0=0.1, seed=1))
    >>> for _ in range(300):
    ...     optimiser.tell(-np.square(optimiser.ask() - 1).sum(axis=1))
    >>> bool(np.abs(optimiser.mean - 1).max() < 0.1)
    True
    """

    options: ClassVar[Mapping[str, str]] = {
        "learning_rate": RATE,
        "sigma_decay": "factor of the step size a generation, 1 at most; default 1",
    }

    def _begin(self) -> None:
        super()._begin()
        self._decay = self._number("sigma_decay", 1.0, most=1.0)

    def tell(self, fitness: Floats) -> None:
        """As of any search gradient."""
        self._climb(_weighted_sum(_centred_ranks(fitness), self._samples) / len(fitness) / self.sigma)
        self._deviations = self._deviations * self._decay


class Pepg(_AdamMean):
    """Parameter-exploring policy gradients with symmetric sampling (Sehnke et al. 2010), by centred ranks.

    Each parameter has a deviation of its own, which changes by at most a fifth a generation. The mean moves by Adam.

    >>> optimiser = Pepg(Search(mean=np.zeros(3), population=8, sigma0=0.1, seed=1))
    >>> for _ in range(300):
    ...     optimiser.tell(-np.square(optimiser.ask() - 1).sum(axis=1))
    >>> bool(np.abs(optimiser.mean - 1).max() < 0.1)
    True
    """

    LARGEST_CHANGE = 0.2
    options: ClassVar[Mapping[str, str]] = {
        "learning_rate": RATE,
        "sigma_rate": "learning rate of the deviations, 1 at most; default 0.2",
    }

    def _begin(self) -> None:
        super()._begin()
        self._sigma_rate = self._number("sigma_rate", 0.2, most=1.0)

    def tell(self, fitness: Floats) -> None:
        """As of any search gradient."""
        ranks = _centred_ranks(fitness)
        # Ranks sum to zero: a pair's two terms are the symmetric estimate, with the mean rank as its baseline.
        gradient = _weighted_sum(ranks, self._samples) / len(fitness) / self._deviations
        relative = self._sigma_rate * _weighted_sum(ranks, self._samples**2 - 1) / len(fitness)
        self._climb(gradient)
        self._deviations = self._deviations * (1 + np.clip(relative, -self.LARGEST_CHANGE, self.LARGEST_CHANGE))


class Snes(SearchGradient):
    """Separable natural evolution strategy (Schaul et al. 2011; utilities and rates of Wierstra et al. 2014).

    >>> optimiser = Snes(Search(mean=np.zeros(3), population=8, sigma0=0.1, seed=1))
    >>> for _ in range(300):
    ...     optimiser.tell(-np.square(optimiser.ask() - 1).sum(axis=1))
    >>> bool(np.abs(optimiser.mean - 1).max() < 1e-6)
    True
    """

    mirrored = False

    def tell(self, fitness: Floats) -> None:
        """As of any search gradient."""
        count, dimension = self._samples.shape
        best_first = np.maximum(0, math.log(count / 2 + 1) - np.log(np.arange(1, count + 1)))
        utilities = _by_rank(fitness, (best_first / best_first.sum() - 1 / count)[::-1])
        rate = (3 + math.log(dimension)) / (5 * math.sqrt(dimension))
        self._mean = self._mean + self._deviations * _weighted_sum(utilities, self._samples)
        self._deviations = self._deviations * np.exp(rate / 2 * _weighted_sum(utilities, self._samples**2 - 1))


def _by_rank(fitness: Floats, values: Floats) -> Floats:
    """The value of each fitness' rank, worst first; equal fitness shares the mean of its values, all `(population,)`.

    >>> _by_rank(np.array([5.0, 1.0, 1.0]), np.array([0.0, 1.0, 2.0])).tolist()
    [2.0, 0.5, 0.5]
    """
    _, place, counts = np.unique(fitness, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    means = [values[end - count : end].mean() for end, count in zip(ends, counts, strict=True)]
    return np.array(means)[place]


def _centred_ranks(fitness: Floats) -> Floats:
    """Ranks scaled to the range from -0.5, the worst, to 0.5 (Salimans et al. 2017, section 2.1)."""
    return _by_rank(fitness, np.linspace(-0.5, 0.5, len(fitness)))


def _weighted_sum(weights: Floats, rows: Floats) -> Floats:
    """The sum of rows `(population, dimension)`, each times its weight, in their order."""
    total: Floats = (weights[:, None] * rows).sum(axis=0)
    return total
