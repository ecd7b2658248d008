"""Bounds of results, so that all statistics of them stay finite and storable. No input or output.

The worker checks them so that its message fits the schema, the coordinator before it writes the journal.
"""

import math
import sys

from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.messages import MAX_LEASES

# Its square, summed over the largest run, is far below the largest double, 1.8e308.
LARGEST_FITNESS = 1e100
LONGEST_EPISODE = 10**6  # steps of a whole episode; the horizon bounds scored ones
MAX_SECONDS = 1e9
MAX_COUNT = 2**63 - 1  # the largest integer in SQLite and in messages
OUT_OF_BOUNDS, TOO_LONG, IMPOSSIBLE_TIME = "fitness out of bounds", "too many steps", "impossible time"  # causes


def max_steps(horizon: int) -> int:
    """Maximum environment steps of one job; a task that batches jobs may count the steps of a whole batch."""
    return horizon * MAX_LEASES


def rejection_reason(fitness: float, steps: int, seconds: float, horizon: int) -> Failure | None:
    """Why a result must be rejected; `None` if it is valid."""
    if not abs(fitness) <= LARGEST_FITNESS:  # false of NaN too
        cause = OUT_OF_BOUNDS
        detail = f"the episode gave {fitness:g}, which must lie within ±{LARGEST_FITNESS:g}: scale the reward"
    elif not 0 <= steps <= max_steps(horizon):
        cause, detail = TOO_LONG, f"the episode has {steps:.6g} steps, more than the allowed {horizon}"
    elif not 0 <= seconds <= MAX_SECONDS:
        cause, detail = IMPOSSIBLE_TIME, f"the episode took {seconds:g} seconds"
    else:
        return None
    return Failure(f"{cause}: {detail}", cause)


def clamp_count(number: int) -> int:
    """Clamp a count to the range from 0 to `MAX_COUNT`."""
    return min(max(number, 0), MAX_COUNT)


def to_finite(value: float | None) -> float:
    """Convert a stored number to a finite one; `NULL`, which SQLite stores for NaN, is 0."""
    if value is None or math.isnan(value):
        return 0.0
    return min(max(value, -sys.float_info.max), sys.float_info.max)
