"""Which worker is given the next job. Pure.

The least loaded one, unless it is known to be slower than others: then only what it should bring back before these have
done all the rest. So a worker that is slow, far away or often lost is given less, or nothing. Rule 3 of the protocol.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from dreamfleet.coordinator.dispatch.member import Member

PEER_RATIO = 1.5  # times slower than the best at most: such workers share evenly
REST_FRACTION = 0.8  # part of the time that the others need for the rest in which a slower worker must be back


class WorkerSelection:
    """Chooses among `members`, who hold `loads` jobs, while so many `waiting` are in the queue."""

    def __init__(self, members: Mapping[str, Member], loads: Mapping[str, int], waiting: int, now: float) -> None:
        self._members = members
        self._loads = dict(loads)
        self._waiting = waiting
        self._now = now
        self._dependable = {name for name, member in members.items() if is_dependable(member, now)}
        self._jobs = sum(len(members[name].leases) for name in self._dependable)
        self._rate = sum(members[name].host_stats.rate for name in self._dependable)
        self._expected_seconds = {
            name: members[name].host_stats.expected_seconds(load + 1) for name, load in loads.items()
        }
        full = (
            members[name].host_stats.expected_seconds(len(members[name].leases) + 1)
            for name in self._dependable - loads.keys()
        )
        self._soonest_full = min(full, default=math.inf)  # seconds of the soonest that may be given no more now
        self._best: dict[int, list[tuple[float, str]]] = {}  # by number of jobs: the two that are soonest

    def assign(self, name: str) -> None:
        """It is given one."""
        self._loads[name] += 1
        self._expected_seconds[name] = self._members[name].host_stats.expected_seconds(self._loads[name] + 1)
        self._waiting -= 1
        self._jobs += name in self._dependable

    def pick(self, eligible: Collection[str]) -> str | None:
        """The worker to give the next job to; `None` if a worker that is not `eligible` now is worth waiting for."""
        fit = [name for name in eligible if self._finishes_in_time(name)]
        if not fit:
            return self._soonest(eligible)
        return min(
            fit, key=lambda name: (self._loads[name] / self._members[name].capacity, self._expected_seconds[name])
        )

    def _soonest(self, eligible: Collection[str]) -> str | None:
        """The soonest of all, unless that is one that may be given no more now."""
        candidates = self._dependable & self._expected_seconds.keys()
        first = min(candidates, key=self._expected_seconds.__getitem__, default=None)
        return first if first in eligible and self._expected_seconds[str(first)] <= self._soonest_full else None

    def _finishes_in_time(self, name: str) -> bool:
        if self._dependable <= {name}:
            return True  # nobody else is there whom it could keep waiting
        member = self._members[name]
        if name not in self._dependable or member.host_stats.is_likely_lost(
            self._loads[name] + 1, self._now - member.joined_at
        ):
            return False
        return self._expected_seconds[name] <= max(
            PEER_RATIO * self._best_other_seconds(name), REST_FRACTION * self._rest_seconds(name)
        )

    def _rest_seconds(self, name: str) -> float:
        """Seconds that the others need for what they hold and what waits."""
        jobs = self._waiting + self._jobs - self._loads[name]
        return jobs / max(self._rate - self._members[name].host_stats.rate, 1e-9)

    def _best_other_seconds(self, name: str) -> float:
        """Seconds in which the best of the others brings as many jobs back as this one would hold."""
        size = self._loads[name].bit_length()
        if size not in self._best:
            records = ((self._members[other].host_stats.expected_seconds(2**size), other) for other in self._dependable)
            self._best[size] = sorted(records)[:2]
        return next(seconds for seconds, other in self._best[size] if other != name)


def is_dependable(member: Member, now: float) -> bool:
    """Whether a worker is known to bring jobs back, and free to."""
    known = member.present and member.capacity and member.host_stats.has_history
    return (
        bool(known)
        and member.background_slots < member.slots
        and not member.host_stats.is_likely_lost(1, now - member.joined_at)
    )
