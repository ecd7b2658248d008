"""Which worker is given the next job. Pure.

The least loaded one, unless it is known to be slower than others: then only what it should bring back before these have
done all the rest. So a worker that is slow, far away or often lost is given less, or nothing. Rule 3 of the protocol.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from dreamfleet.coordinator.member import Member

PEER = 1.5  # times slower than the best at most: such workers share evenly
HASTE = 0.8  # part of the time that the others need for the rest in which a slower worker must be back


class Choice:
    """Chooses among `members`, who hold `loads` jobs, while so many `waiting` are in the queue."""

    def __init__(self, members: Mapping[str, Member], loads: Mapping[str, int], waiting: int, now: float) -> None:
        self._members = members
        self._loads = dict(loads)
        self._waiting = waiting
        self._now = now
        self._fit = {name for name, member in members.items() if reckoned_with(member, now)}
        self._jobs = sum(len(members[name].leases) for name in self._fit)
        self._rate = sum(members[name].record.rate for name in self._fit)
        self._soon = {name: members[name].record.expected(load + 1) for name, load in loads.items()}
        full = (members[name].record.expected(len(members[name].leases) + 1) for name in self._fit - loads.keys())
        self._full = min(full, default=math.inf)  # seconds of the soonest that may be given no more now
        self._best: dict[int, list[tuple[float, str]]] = {}  # by number of jobs: the two that are soonest

    def take(self, name: str) -> None:
        """It is given one."""
        self._loads[name] += 1
        self._soon[name] = self._members[name].record.expected(self._loads[name] + 1)
        self._waiting -= 1
        self._jobs += name in self._fit

    def pick(self, able: Collection[str]) -> str | None:
        """The worker to give the next job to; `None`: it had better wait for one that is not `able` now."""
        fit = [name for name in able if self._helps(name)]
        if not fit:
            return self._first(able)
        return min(fit, key=lambda name: (self._loads[name] / self._members[name].capacity, self._soon[name]))

    def _first(self, able: Collection[str]) -> str | None:
        """The soonest of all, unless that is one that may be given no more now."""
        candidates = self._fit & self._soon.keys()
        first = min(candidates, key=self._soon.__getitem__, default=None)
        return first if first in able and self._soon[str(first)] <= self._full else None

    def _helps(self, name: str) -> bool:
        if self._fit <= {name}:
            return True  # nobody else is there whom it could keep waiting
        member = self._members[name]
        if name not in self._fit or member.record.risky(self._loads[name] + 1, self._now - member.born):
            return False
        return self._soon[name] <= max(PEER * self._best_beside(name), HASTE * self._rest(name))

    def _rest(self, name: str) -> float:
        """Seconds that the others need for what they hold and what waits."""
        jobs = self._waiting + self._jobs - self._loads[name]
        return jobs / max(self._rate - self._members[name].record.rate, 1e-9)

    def _best_beside(self, name: str) -> float:
        """Seconds in which the best of the others brings as many jobs back as this one would hold."""
        size = self._loads[name].bit_length()
        if size not in self._best:
            records = ((self._members[other].record.expected(2**size), other) for other in self._fit)
            self._best[size] = sorted(records)[:2]
        return next(seconds for seconds, other in self._best[size] if other != name)


def reckoned_with(member: Member, now: float) -> bool:
    """Whether a worker is known to bring jobs back, and free to."""
    known = member.present and member.capacity and member.record.known
    return bool(known) and member.occupied < member.slots and not member.record.risky(1, now - member.born)
