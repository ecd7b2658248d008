"""The end of a generation: when nothing is left to give, idle slots take over what waits elsewhere. Pure.

First jobs that another worker was given and cannot have begun; then, where it should pay, a second copy of a straggler.
A worker of which nothing is known, or nothing new, is given copies only: they show what it is worth, and nobody waits
for them. Rule 8 of the protocol.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Protocol

from dreamfleet.coordinator.choice import reckoned_with
from dreamfleet.coordinator.jobs import Work
from dreamfleet.coordinator.member import Lease, Member
from dreamfleet.coordinator.record import HostRecord

SMOOTHING = 0.1  # weight of the newest episode in the typical one
QUIET_BEATS = 2  # without a word: a straggler that nothing is known of
UPLOAD_SECONDS = 30.0  # after a result, in which its upload should have come
MARGIN = 1.5  # how many times sooner a copy must be expected to finish
HELD, HELD_TIMES = 60.0, 8.0  # seconds, and times that a job of its kind was away: longer no worker's word is relied on
STALE, STALE_TIMES = 10.0, 20.0  # seconds, and turnarounds: what is known of a host is old then


class Wanted(Protocol):
    """What is known of a wanted job."""

    work: Work
    holders: set[str]

    @property
    def shunned(self) -> Set[str]:
        """Workers that are not to have it."""
        ...


@dataclass(frozen=True)
class Move:
    """Give a job to another worker: a copy, or `instead_of` one that has not begun it; `trial`: to get to know it."""

    digest: bytes
    to: str
    instead_of: str | None = None
    trial: bool = False


class Tail:
    """Plans moves; remembers how long an episode typically is, in steps."""

    def __init__(self, beat: float) -> None:
        self._beat = beat
        self._typical = 0.0
        self._away = {False: 0.0, True: 0.0}  # seconds, by whether jobs fill the slack

    def took(self, seconds: float, *, in_slack: bool) -> None:
        """A job that was accepted had been with its worker for so long, by our clock."""
        before = self._away[in_slack]
        self._away[in_slack] += SMOOTHING * (seconds - before) if before else seconds

    def learn(self, steps: int) -> None:
        """An episode of so many steps was accepted."""
        self._typical += SMOOTHING * (steps - self._typical) if self._typical else steps

    def plan(
        self,
        wanted: Mapping[bytes, Wanted],
        members: Mapping[str, Member],
        given: Mapping[str, Sequence[Work]],
        now: float,
    ) -> Iterator[Move]:
        """Moves for the slots that are idle, fastest first; `given` is about to be sent."""
        present = [member for member in members.values() if member.present and member.capacity]
        loads = {member.identity: len(member.leases) + len(given.get(member.identity, ())) for member in present}
        idle = [member for member in present if loads[member.identity] < member.capacity]
        moved: set[bytes] = set()
        for taker in sorted(idle, key=lambda member: (member.record.expected(1), -member.pace)):
            for move in self._moves(taker, present, loads, wanted, moved, now):
                moved.add(move.digest)
                loads[taker.identity] += 1
                if move.instead_of:
                    loads[move.instead_of] -= 1
                yield move

    def _moves(
        self, taker: Member, present: Sequence[Member], loads: Mapping[str, int], wanted: Mapping[bytes, Wanted],
        moved: set[bytes], now: float,
    ) -> Iterator[Move]:  # fmt: skip
        """What this worker takes until its slots are full."""
        others = [member for member in present if member is not taker]
        if not taker.record.known and any(reckoned_with(other, now) for other in others):
            return  # it is tried first
        stragglers = self._stragglers(others, taker, wanted, now)
        while loads[taker.identity] < taker.capacity:
            soon = self._soon(taker, loads[taker.identity] + 1)
            if (move := self._recall(taker, soon, others, loads, wanted, moved, now)) is not None:
                yield move
                continue
            pays = (
                each for left, each in stragglers if each not in moved and (left > MARGIN * soon or left == math.inf)
            )
            if (copied := next(pays, None)) is None:
                return
            yield Move(copied, taker.identity)

    def _soon(self, taker: Member, jobs: int) -> float:
        if not taker.record.known and taker.pace and self._typical:
            return self._typical / taker.pace
        return taker.record.expected(jobs)

    def trials(
        self, wanted: Mapping[bytes, Wanted], members: Mapping[str, Member], busy: Collection[str], now: float
    ) -> Iterator[Move]:
        """A copy for each idle worker of which nothing is known, or nothing new, beside one that is known."""
        present = [member for member in members.values() if member.present and member.capacity]
        for taker in present:
            if taker.leases or taker.identity in busy or not _is_due(taker, now):
                continue
            known = [other for other in present if other is not taker and reckoned_with(other, now)]
            donors = sorted(known, key=lambda member: -len(member.leases) / member.capacity)
            copied = (digest for donor in donors for digest, lease in reversed(donor.leases.items())
                      if not lease.in_slack and _alone(digest, taker, wanted))  # fmt: skip
            if (digest := next(copied, None)) is not None:
                yield Move(digest, taker.identity, trial=True)

    def _recall(
        self, taker: Member, soon: float, others: Sequence[Member], loads: Mapping[str, int],
        wanted: Mapping[bytes, Wanted], moved: set[bytes], now: float,
    ) -> Move | None:  # fmt: skip
        """The job that was given last to whoever has most waiting: more leases than slots means that some wait."""
        donors = [member for member in others if loads[member.identity] > member.capacity]
        for donor in sorted(donors, key=lambda member: -loads[member.identity] / member.capacity):
            for digest, lease in reversed(donor.leases.items()):
                waits = lease.steps is None and lease.ended is None and digest not in moved
                if waits and _alone(digest, taker, wanted):
                    known = taker.record.known and donor.record.known
                    if known and _left(donor, lease, now) <= soon and not donor.occupied:
                        break  # it is back sooner from where it is
                    return Move(digest, taker.identity, donor.identity)
        return None

    def _stragglers(
        self, others: Sequence[Member], taker: Member, wanted: Mapping[bytes, Wanted], now: float
    ) -> list[tuple[float, bytes]]:
        """Jobs that this worker may copy, and the seconds that they still take where they are; the longest first."""
        known = [member.record for member in (*others, taker) if member.record.known]
        found = []
        for holder in others:
            for digest, lease in holder.leases.items():
                if _alone(digest, taker, wanted):
                    left = self._still(holder, lease, taker, known, now)
                    found.append((left, digest))
        return sorted(found, key=lambda each: -each[0])

    def _still(
        self, holder: Member, lease: Lease, taker: Member, known: Sequence[HostRecord], now: float
    ) -> float:  # fmt: skip
        """Seconds that a job should still take where it is; of two estimates the longer."""
        quiet = now - holder.heard
        if quiet > QUIET_BEATS * self._beat:
            return math.inf
        if now - lease.handful.given > HELD + HELD_TIMES * self._away[lease.in_slack]:
            return math.inf  # whatever it tells of its steps: anybody can tell them
        if lease.ended is not None:
            return math.inf if now - lease.ended > UPLOAD_SECONDS else 0.0
        if lease.steps is None:
            return 0.0 if lease.in_slack or not taker.record.known else _overdue(holder, lease, known, now)
        left = _left(holder, lease, now) if holder.record.known and not lease.in_slack else 0.0
        if holder.pace and taker.pace and self._typical:
            since = holder.pace * (now - lease.told)
            steps = max(self._typical - lease.steps - since, self._typical / 10)
            left = max(left, steps / holder.pace)
        return left


def _alone(digest: bytes, taker: Member, wanted: Mapping[bytes, Wanted]) -> bool:
    """Whether a job is in one worker's hands and may be given to another."""
    job = wanted.get(digest)
    return job is not None and len(job.holders) == 1 and taker.identity not in job.shunned


def _is_due(taker: Member, now: float) -> bool:
    """Whether it is time to try a worker: at once if it is unknown, else when what is known is old."""
    if taker.trials or taker.occupied:
        return False
    return not taker.record.known or now - taker.record.learned > max(STALE, STALE_TIMES * taker.record.expected(1))


def _left(holder: Member, lease: Lease, now: float) -> float:
    """Seconds until a job should be back; below 0 if it is late."""
    expected = holder.record.expected(lease.handful.before + lease.handful.back + 1)
    return lease.handful.given + expected - now


def _overdue(holder: Member, lease: Lease, known: Sequence[HostRecord], now: float) -> float:
    """Seconds until a job that was not seen to run should be back: one that is late, as long again as it is late.

    Of a host of which nothing is known yet no more is expected than of the best that is.
    """
    jobs = lease.handful.before + lease.handful.back + 1
    records = [holder.record] if holder.record.known else known
    left = lease.handful.given + min(record.expected(jobs) for record in records) - now
    return left if left > 0 else -left
