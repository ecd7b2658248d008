"""The standard error of a mean: the one place that computes it, and that prints it after a ±.

It follows from the sample's standard deviation, with n - 1 in the denominator. One value has none: `None`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import stdev

SMALL, MAX_DIGITS = 0.1, 6  # below it a score has more decimals than one, up to so many


def sample_std(values: Sequence[float]) -> float | None:
    """The sample's standard deviation (n - 1); `None` for one value."""
    return stdev(values) if len(values) > 1 else None


def standard_error(values: Sequence[float]) -> float | None:
    """The standard error of the mean of `values`; `None` for one value."""
    return error_from_sample_std(sample_std(values), len(values))


def error_from_sample_std(std: float | None, count: int) -> float | None:
    """The standard error of the mean of `count` values, from their sample standard deviation."""
    return None if std is None or count < 2 else std / math.sqrt(count)


def error_from_population_std(std: float, count: int) -> float | None:
    """Like `error_from_sample_std`, from a standard deviation with n in the denominator."""
    return None if count < 2 else std / math.sqrt(count - 1)


def score_digits(mean: float, error: float | None) -> int:
    """Decimals of a score: one, or as many as show the first figure of a small error, or of a small mean without one.

    >>> score_digits(875.62, 4.73), score_digits(0.1234, 0.0031)
    (1, 3)
    """
    size = abs(error or mean)
    return min(MAX_DIGITS, -math.floor(math.log10(size))) if 0 < size < SMALL else 1


def format_with_error(mean: float, error: float | None, digits: int | None = None, sign: str = "") -> str:
    """A mean ± its standard error; the mean alone if it has none. `sign` is the format's, such as `+` or `,`.

    Without `digits` it has those of `score_digits`.
    """
    digits = score_digits(mean, error) if digits is None else digits
    plus, comma = "+" if "+" in sign else "", "," if "," in sign else ""
    after = "" if error is None else f" ± {error:{comma}.{digits}f}"
    return f"{mean:{plus}z{comma}.{digits}f}{after}"
