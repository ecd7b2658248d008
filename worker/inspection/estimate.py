"""A measured figure and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Estimate:
    """A value and its standard error."""

    value: float
    error: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Estimate:
        """The mean of two values at least."""
        return cls(float(np.mean(values)), float(np.std(values, ddof=1) / len(values) ** 0.5))

    def __str__(self) -> str:
        return f"{self.value:.2f} ± {self.error:.2f}"
