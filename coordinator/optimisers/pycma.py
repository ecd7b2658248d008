"""CMA-ES by Hansen's own library, pycma, with a full or a diagonal covariance matrix. Pages: determinism.md."""

import json
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any, ClassVar
from warnings import catch_warnings, filterwarnings

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.packages import hidden
from dreamfleet.common.printable import plural
from dreamfleet.coordinator.optimisers import pycma_state
from dreamfleet.coordinator.optimisers.api import Footprint, Search, State

if sys.flags.optimize > 1:  # pycma joins its docstrings as it is imported
    raise UsageError("the package cma needs its docstrings: start Python without -OO, and PYTHONOPTIMIZE at 1 at most")

# pycma's core needs neither, and a coordinator need not have them: importing them takes most of its start.
with hidden("matplotlib", "scipy"), catch_warnings():
    filterwarnings("ignore", "Could not import matplotlib")
    import cma

HISTORY = 100  # entries that stay of each of pycma's histories
FURTHEST_FACTOR = 1e60  # from one: a factor that is further away is brought back


class Pycma:
    """CMA-ES (Hansen 2016, arXiv:1604.00772, algorithm of appendix A) over the whole covariance matrix or its diagonal.

    The diagonal alone (Ros and Hansen 2008, "A Simple Modification in CMA-ES Achieving Linear Time and Space
    Complexity") has n numbers to learn instead of n squared, and costs as little. From 300 parameters on pycma adapts
    the step size by two points along the last step (Hansen 2008, arXiv:0805.0231) instead of by the evolution path
    (equations 43 and 44).

    >>> optimiser = Pycma(Search(mean=np.zeros(3), population=4, sigma0=0.1, seed=1, options={"covariance": "full"}))
    >>> candidates = optimiser.ask()
    >>> optimiser.tell(-np.square(candidates - 1).sum(axis=1))
    """

    requirement: ClassVar[str] = f"cma=={version('cma')}"
    options: ClassVar[Mapping[str, str]] = {"covariance": "diagonal or full; also as --covariance"}

    def __init__(self, search: Search) -> None:
        self._search = search
        self._diagonal = search.choice("covariance", "diagonal", "full") == "diagonal"
        self._refuse_too_few_candidates()
        self._normals = Normals(search.seed)
        self._asked: list[NDArray[np.float64]] = []
        self._begin(search.mean)

    @classmethod
    def footprint(cls, dimension: int, population: int, options: Mapping[str, str]) -> Footprint:
        """As measured: so many populations and, with `full`, so many square matrices, of which four are state."""
        square = dimension**2 if options.get("covariance") == "full" else 0
        return Footprint(8 * (9 * population * dimension + 14 * square), 8 * 4 * square)

    @property
    def mean(self) -> NDArray[np.float64]:
        """The distribution's mean `(dimension,)`."""
        return np.asarray(self._strategy.mean, dtype=np.float64).copy()

    @property
    def sigma(self) -> float:
        """The step size: the standard deviation of the middle coordinate.

        pycma's own `sigma` is one of its three factors, which may drift apart without end while they balance.
        """
        return float(np.median(self._strategy.stds))

    @property
    def axis_ratio(self) -> float:
        """The longest axis of the distribution by the shortest."""
        axes = self._strategy.stds if self._diagonal else self._strategy.sm.D
        return float(np.max(axes) / np.min(axes))

    def ask(self) -> NDArray[np.float64]:
        """Sample the next population `(population, dimension)` (equations 38 to 40)."""
        self._asked = [np.asarray(x, dtype=np.float64) for x in self._strategy.ask()]
        return np.stack(self._asked)

    def redraw(self, indices: Sequence[int]) -> NDArray[np.float64]:
        """Sample these candidates again (equations 38 to 40), except the two along the last step."""
        kept = 2 if self._strategy.mean_shift_samples and self._strategy.countiter > 1 else 0
        for index in indices:
            if index >= kept:
                self._asked[index] = np.asarray(self._strategy.ask(1)[0], dtype=np.float64)
        return np.stack([self._asked[index] for index in indices])

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Update mean, step size and covariance (equations 41 to 47)."""
        self._strategy.tell(self._asked, [-float(value) for value in fitness])
        self._asked = []
        # Histories by which pycma would stop by itself, which nothing else reads: a state must not grow with the run.
        del self._strategy.fit.histbest[HISTORY:], self._strategy.fit.histmedian[HISTORY:]
        scaling = self._strategy.sigma_vec.scaling
        if (
            self._diagonal
            and (scaling.min() < 1 / FURTHEST_FACTOR or scaling.max() > FURTHEST_FACTOR)
            and self.sigma > 0
        ):
            self._balance()

    def prepare(self) -> None:
        """Draw the normals of the next `ask`, which do not depend on `tell`."""
        self._normals.draw_ahead(self._search.population, self._search.dimension)

    def state(self) -> State:
        """The leaves of pycma's objects, and the generator's state."""
        return {**pycma_state.dump(self._strategy), "random": np.array(json.dumps(self._normals.state))}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a `state`."""
        arrays = dict(state)
        random = json.loads(str(arrays.pop("random")))
        self._begin(arrays["mean"].astype(np.float64))
        if not pycma_state.is_before_first_update(arrays):
            # pycma builds some of its parts in the first `ask` and `tell`; they must exist to be overwritten.
            self.ask()
            self.tell(np.arange(self._search.population, dtype=np.float64))
            pycma_state.restore(self._strategy, arrays)
        self._normals.state = random

    def _begin(self, mean: NDArray[np.float64]) -> None:
        options = {
            "popsize": self._search.population,
            "CMA_diagonal": self._diagonal,
            "seed": np.nan,  # leave NumPy's global source alone: a number here would make continuation inexact
            "randn": self._normals,
            "verbose": -9,
        }
        self._strategy = cma.CMAEvolutionStrategy(mean, self._search.sigma0, options)

    def _balance(self) -> None:
        """Write the same distribution with factors near one; after tens of thousands of generations they overflow.

        A deviation is step size x scaling x the sampler's deviation. The paths are kept in units of the third (`pc`)
        and of the last two (`pc2`), so that they change with these.
        """
        strategy, middle = self._strategy, self.sigma
        ratio = middle / strategy.sigma
        deviations = np.sqrt(strategy.sm.variances)
        strategy.sigma_vec.scaling *= deviations / ratio
        strategy.pc /= deviations
        strategy.pc2 /= ratio
        strategy.sm *= 1 / deviations.max() ** 2
        strategy.sigma, strategy.adapt_sigma.delta = middle, middle / strategy.sigma0
        strategy._updateBDfromSM()

    def _refuse_too_few_candidates(self) -> None:
        """Two-point step sizes put two candidates on the last step, and populations below 6 hold a mirrored one too."""
        two_point = self._search.dimension >= cma.evolution_strategy.TPA_dimension
        if two_point and self._search.population < 3:
            raise UsageError(
                f"cma needs a population of at least 3 for {plural(self._search.dimension, 'parameter')}, not "
                f"{self._search.population}: give --population"
            )


class Normals:
    """Standard normal samples for pycma's option `randn`, from a generator whose state can be stored.

    Samples can be drawn ahead while the coordinator is idle; that changes no number.
    """

    def __init__(self, seed: int) -> None:
        self._generator = np.random.Generator(np.random.PCG64(seed))
        # The state before the draw, and the samples.
        self._ahead: tuple[dict[str, Any], NDArray[np.float64]] | None = None

    def __call__(self, *shape: int) -> NDArray[np.float64]:
        """Draw an array of `shape`."""
        if self._ahead is not None and self._ahead[1].shape == shape:
            _, drawn = self._ahead
            self._ahead = None
            return drawn
        self.state = self.state
        return self._generator.standard_normal(shape)

    def draw_ahead(self, *shape: int) -> None:
        """Draw the array that the next call with `shape` will return."""
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
