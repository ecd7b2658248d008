"""Fields of a model's configuration: the bounds of its sizes, and factors that weight the parts of a loss."""

from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.common.schema.validation import added_option

LARGEST = 2**14  # of a layer, a kernel or a window: beyond it torch overflows, or the memory
LEAST, MOST = 1e-6, 1e6  # beyond these, float32 loses the smaller part of the sum


def loss_factor(text: str) -> Any:
    """A field with the factor of a part of a model's loss; the default 1 is not serialised."""
    return added_option(1.0, f"{text}; 1 as its source has it")


def check_factors(config: Any, *names: str) -> None:
    """`UsageError` names the first of these fields that is out of bounds."""
    for name in names:
        if not LEAST <= getattr(config, name) <= MOST:
            raise UsageError(f"{name} must be from {LEAST:g} to {MOST:g}, not {getattr(config, name):g}")


def check_sizes(config: object) -> None:
    """`UsageError` if a whole number of the configuration, alone or in a list, is above `LARGEST`."""
    for name, value in vars(config).items():
        numbers = value if isinstance(value, tuple) else (value,)
        if any(isinstance(each, int) and each > LARGEST for each in numbers):
            raise UsageError(f"--{name.replace('_', '-')} must be at most {LARGEST}, not {max(numbers)}")
