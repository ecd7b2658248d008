"""The one place that computes a standard error, from the sample's deviation, and prints it. Pages: results.md."""

import math
from collections.abc import Sequence
from statistics import stdev

from dreamfleet.common.printable import format_number

MAX_DIGITS = 6  # decimals of a score


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
    return None if count < 2 else std / math.sqrt(count - 1)  # docs/how-to/export.md says which has n


def score_digits(mean: float, error: float | None) -> int:
    """Decimals of a score: one, or as many as show the first figure of a small error.

    Without an error the mean has four significant digits, and at least one decimal. `runs.js` counts alike.

    >>> score_digits(875.62, 4.73), score_digits(0.1234, 0.0031), score_digits(-3.98712, None)
    (1, 3, 3)
    """
    size, figures = (abs(error), 0) if error else (abs(mean), 3)
    wanted = figures - math.floor(math.log10(size)) if 0 < size < math.inf else 1
    return min(max(wanted, 1), MAX_DIGITS)


def format_with_error(mean: float, error: float | None, digits: int | None = None, sign: str = "") -> str:
    """A mean ± its standard error; the mean alone if it has none. `sign` is as of `format_number`.

    Without `digits` it has those of `score_digits`, and without an error too those of `format_number`.
    """
    if digits is None and (not error or abs(error) < 10**-MAX_DIGITS):  # no error says which digits are noise
        return f"{format_number(mean, sign)}{'' if error is None else f' ± {error:.1g}'}"
    digits = score_digits(mean, error) if digits is None else digits
    after = "" if error is None else f" ± {error:,.{digits}f}"
    return f"{mean:{sign}z,.{digits}f}{after}"
