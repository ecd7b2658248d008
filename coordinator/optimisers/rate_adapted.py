"""CMA-ES that adapts its learning rates, from the library `cmaes`."""

from __future__ import annotations

from typing import Any, ClassVar

import cmaes
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.cmaes_library import CmaesOptimiser


class RateAdapted(CmaesOptimiser):
    """CMA-ES that keeps the signal-to-noise ratio of its updates constant (Nomura et al. 2023, arXiv:2304.03473).

    Mean and covariance are updated as by Hansen 2016 (arXiv:1604.00772, equations 38 to 47), then each step is
    shortened by a learning rate of its own, at most 1, so that noise or many optima slow it down instead of leading it
    astray at the default population. It holds the full matrix: cost and state grow with the square of the parameters
    and more, see `docs/optimisers.md`.

    >>> optimiser = RateAdapted(Search(mean=np.zeros(3), population=4, sigma0=0.1, seed=1))
    >>> candidates = optimiser.ask()
    >>> optimiser.tell(-np.square(candidates - 1).sum(axis=1))
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "mean", "sigma", "C", "p_sigma", "pc", "g", "Emean", "ESigma", "Vmean", "VSigma", "eta_mean", "eta_Sigma",
    )  # fmt: skip

    def ask(self) -> NDArray[np.float64]:
        """Sample the next population `(population, dimension)` (equations 38 to 40 of Hansen 2016).

        The library's own `ask` multiplies B with D as two full matrices anew for each candidate; these are its bits.
        """
        strategy = self._strategy
        eigenvectors, roots = strategy._eigen_decomposition()
        axes = np.ascontiguousarray(eigenvectors * roots)
        normals = (strategy._rng.randn(self._search.dimension) for _ in range(self._search.population))
        self._asked = [strategy._mean + strategy._sigma * axes.dot(z) for z in normals]
        return np.stack(self._asked)

    def _build(self, search: Search) -> Any:
        if search.population < 4:
            # Below 4 a single parent is selected: mu_eff is 1, and so the rate of the rank-mu update 0 (equation 58).
            raise UsageError(f"cmaes-lra needs a population of at least 4, not {search.population}: give --population")
        return cmaes.CMA(
            search.mean.copy(), search.sigma0, seed=search.seed, population_size=search.population, lr_adapt=True
        )
