"""How many episodes a second the workers that are there drive, by what their last ones took. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from dreamfleet.coordinator.dispatch.host_stats import HostStats
from dreamfleet.coordinator.dispatch.member import Member


def episodes_per_second(members: Iterable[Member], seconds: Callable[[HostStats], float | None]) -> float | None:
    """Of the present ones together, where an episode takes a slot so many `seconds`; `None` where none has shown it.

    A worker that has not shown it yet counts as the others do.
    """
    slots, rate, shown = 0, 0.0, 0
    for member in members:
        if member.present:
            slots += member.slots
            if (each := seconds(member.host_stats)) is not None:
                rate += member.slots / max(each, 1e-6)
                shown += member.slots
    return rate * slots / shown if shown else None
