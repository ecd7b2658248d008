"""What a result may say, so that everything computed from it is still a number that can be kept and told. Pure.

Both sides look: the worker, so that its message is of the schema, and the coordinator, before anything is journalled.
"""

from __future__ import annotations

import math
import sys

from dreamfleet.common.protocol.messages import MAX_LEASES

# Squared and summed over the largest run this is still far below 1.8e308, which a mean or a deviation must not reach.
LARGEST_FITNESS = 1e100
LONGEST_EPISODE = 10**6  # steps of a whole one; a scored one has the specification's horizon
MAX_SECONDS = 1e9
MAX_COUNT = 2**63 - 1  # what SQLite and every message's count can hold


def max_steps(horizon: int) -> int:
    """Environment steps of one job at most: an episode's, or where a task counts them together a whole turn's."""
    return horizon * MAX_LEASES


def rejection_reason(fitness: float, steps: int, seconds: float, horizon: int) -> str | None:
    """Why a result cannot count, in words; `None` if it can."""
    if not abs(fitness) <= LARGEST_FITNESS:  # false of NaN too
        return f"the episode gave the fitness {fitness:g}, which must lie within ±{LARGEST_FITNESS:g}: scale the reward"
    if not 0 <= steps <= max_steps(horizon):
        return f"the episode counts {steps:.6g} steps, and may have {horizon} of them"
    if not 0 <= seconds <= MAX_SECONDS:
        return f"the episode took {seconds:g} seconds, which no clock says"
    return None


def clamp_count(number: int) -> int:
    """A count as it can be kept and told: saturated."""
    return min(max(number, 0), MAX_COUNT)


def to_finite(value: float | None) -> float:
    """A stored number as it can be told: older journals hold infinity, and `NULL` for what was not a number."""
    if value is None or math.isnan(value):
        return 0.0
    return min(max(value, -sys.float_info.max), sys.float_info.max)
