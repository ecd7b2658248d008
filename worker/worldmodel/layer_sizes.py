"""The bounds of a model's sizes."""

from __future__ import annotations

from dreamfleet.common.errors import UsageError

LARGEST = 2**14  # of a layer, a kernel or a window: beyond it torch overflows, or the memory


def check_sizes(config: object) -> None:
    """`UsageError` if a whole number of the configuration, alone or in a list, is above `LARGEST`."""
    for name, value in vars(config).items():
        numbers = value if isinstance(value, tuple) else (value,)
        if any(isinstance(each, int) and each > LARGEST for each in numbers):
            raise UsageError(f"--{name.replace('_', '-')} must be at most {LARGEST}, not {max(numbers)}")
