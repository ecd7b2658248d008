"""Factors that weigh the parts of a loss against each other."""

from __future__ import annotations

from dataclasses import field
from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.common.serialization.optional_fields import OPTIONAL

LEAST, MOST = 1e-6, 1e6  # beyond which float32 loses the lighter part beside the heavier one


def added_option(default: Any, text: str) -> Any:
    """A field that a later version added: at its default it is not written."""
    return field(default=default, metadata={**OPTIONAL, "help": text})


def loss_factor(text: str) -> Any:
    """A field of a model's configuration that weighs a part of its loss; 1, which is not written: as it stands."""
    return added_option(1.0, f"{text}; 1 as its source has it")


def check_factors(config: Any, *names: str) -> None:
    """`UsageError` names the first of these fields that weighs nothing, or too much."""
    for name in names:
        if not LEAST <= getattr(config, name) <= MOST:
            raise UsageError(
                f"--{name.replace('_', '-')} must be from {LEAST:g} to {MOST:g}, not {getattr(config, name):g}"
            )
