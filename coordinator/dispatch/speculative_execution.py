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

from dreamfleet.coordinator.dispatch.host_stats import HostStats
from dreamfleet.coordinator.dispatch.member import Lease, Member
from dreamfleet.coordinator.dispatch.worker_selection import is_dependable
from dreamfleet.coordinator.jobs.work import Work

SMOOTHING = 0.1  # weight of the newest episode in the typical one
QUIET_BEATS = 2  # without a word: a straggler that nothing is known of
UPLOAD_SECONDS = 30.0  # after a result, in which its upload should have come
MARGIN = 1.5  # how many times sooner a copy must be expected to finish
LONGEST_HELD, LONGEST_HELD_TIMES = (
    60.0,
    8.0,
)  # seconds, and times that a job of its kind was away: longer no worker's word is relied on
STALE, STALE_TIMES = 10.0, 20.0  # seconds, and turnarounds: what is known of a host is old then


class PendingJobView(Protocol):
    """What is known of a wanted job."""

    work: Work
    holders: set[str]

    @property
    def avoided_workers(self) -> Set[str]:
        """Workers that are not to have it."""
        ...


@dataclass(frozen=True)
class Move:
    """Give a job to another worker: a copy, or `instead_of` one that has not begun it; `trial`: to get to know it."""

    digest: bytes
    to: str
    instead_of: str | None = None
    trial: bool = False


class SpeculativeExecution:
    """Plans moves; remembers how long an episode typically is, in steps."""

    def __init__(self, beat: float) -> None:
        self._beat = beat
        self._typical_steps = 0.0
        self._typical_seconds = {False: 0.0, True: 0.0}  # seconds, by whether jobs fill the slack

    def record_duration(self, seconds: float, *, is_background: bool) -> None:
        """A job that was accepted had been with its worker for so long, by our clock."""
        before = self._typical_seconds[is_background]
        self._typical_seconds[is_background] += SMOOTHING * (seconds - before) if before else seconds

    def record_episode(self, steps: int) -> None:
        """An episode of so many steps was accepted."""
        self._typical_steps += SMOOTHING * (steps - self._typical_steps) if self._typical_steps else steps

    def plan(
        self,
        pending: Mapping[bytes, PendingJobView],
        members: Mapping[str, Member],
        given: Mapping[str, Sequence[Work]],
        now: float,
    ) -> Iterator[Move]:
        """Moves for the slots that are idle, fastest first; `given` is about to be sent."""
        present = [member for member in members.values() if member.present and member.capacity]
        loads = {member.identity: len(member.leases) + len(given.get(member.identity, ())) for member in present}
        idle = [member for member in present if loads[member.identity] < member.capacity]
        moved: set[bytes] = set()
        for taker in sorted(
            idle, key=lambda member: (member.host_stats.expected_seconds(1), -member.slot_steps_per_second)
        ):
            for move in self._moves(taker, present, loads, pending, moved, now):
                moved.add(move.digest)
                loads[taker.identity] += 1
                if move.instead_of:
                    loads[move.instead_of] -= 1
                yield move

    def _moves(
        self,
        taker: Member,
        present: Sequence[Member],
        loads: Mapping[str, int],
        pending: Mapping[bytes, PendingJobView],
        moved: set[bytes],
        now: float,
    ) -> Iterator[Move]:
        """What this worker takes until its slots are full."""
        others = [member for member in present if member is not taker]
        if not taker.host_stats.has_history and any(is_dependable(other, now) for other in others):
            return  # it is tried first
        stragglers = self._stragglers(others, taker, pending, now)
        while loads[taker.identity] < taker.capacity:
            soon = self._expected_seconds(taker, loads[taker.identity] + 1)
            if (move := self._find_recall(taker, soon, others, loads, pending, moved, now)) is not None:
                yield move
                continue
            pays = (
                each for left, each in stragglers if each not in moved and (left > MARGIN * soon or left == math.inf)
            )
            if (copied := next(pays, None)) is None:
                return
            yield Move(copied, taker.identity)

    def _expected_seconds(self, taker: Member, jobs: int) -> float:
        if not taker.host_stats.has_history and taker.slot_steps_per_second and self._typical_steps:
            return self._typical_steps / taker.slot_steps_per_second
        return taker.host_stats.expected_seconds(jobs)

    def plan_trials(
        self, pending: Mapping[bytes, PendingJobView], members: Mapping[str, Member], busy: Collection[str], now: float
    ) -> Iterator[Move]:
        """A copy for each idle worker of which nothing is known, or nothing new, beside one that is known."""
        present = [member for member in members.values() if member.present and member.capacity]
        for taker in present:
            if taker.leases or taker.identity in busy or not _is_trial_due(taker, now):
                continue
            known = [other for other in present if other is not taker and is_dependable(other, now)]
            donors = sorted(known, key=lambda member: -len(member.leases) / member.capacity)
            copied = (digest for donor in donors for digest, lease in reversed(donor.leases.items())
                      if not lease.is_background and _has_single_holder(digest, taker, pending))  # fmt: skip
            if (digest := next(copied, None)) is not None:
                yield Move(digest, taker.identity, trial=True)

    def _find_recall(
        self, taker: Member, soon: float, others: Sequence[Member], loads: Mapping[str, int],
        pending: Mapping[bytes, PendingJobView], moved: set[bytes], now: float,
    ) -> Move | None:  # fmt: skip
        """The job that was given last to whoever has most waiting: more leases than slots means that some wait."""
        donors = [member for member in others if loads[member.identity] > member.capacity]
        for donor in sorted(donors, key=lambda member: -loads[member.identity] / member.capacity):
            for digest, lease in reversed(donor.leases.items()):
                waits = lease.steps is None and lease.upload_pending_since is None and digest not in moved
                if waits and _has_single_holder(digest, taker, pending):
                    known = taker.host_stats.has_history and donor.host_stats.has_history
                    if known and _seconds_until_due(donor, lease, now) <= soon and not donor.background_slots:
                        break  # it is back sooner from where it is
                    return Move(digest, taker.identity, donor.identity)
        return None

    def _stragglers(
        self, others: Sequence[Member], taker: Member, pending: Mapping[bytes, PendingJobView], now: float
    ) -> list[tuple[float, bytes]]:
        """Jobs that this worker may copy, and the seconds that they still take where they are; the longest first."""
        known = [member.host_stats for member in (*others, taker) if member.host_stats.has_history]
        found = []
        for holder in others:
            for digest, lease in holder.leases.items():
                if _has_single_holder(digest, taker, pending):
                    left = self._remaining_seconds(holder, lease, taker, known, now)
                    found.append((left, digest))
        return sorted(found, key=lambda each: -each[0])

    def _remaining_seconds(
        self, holder: Member, lease: Lease, taker: Member, known: Sequence[HostStats], now: float
    ) -> float:  # fmt: skip
        """Seconds that a job should still take where it is; of two estimates the longer."""
        quiet = now - holder.last_heard
        if quiet > QUIET_BEATS * self._beat:
            return math.inf
        if now - lease.group.given_at > LONGEST_HELD + LONGEST_HELD_TIMES * self._typical_seconds[lease.is_background]:
            return math.inf  # whatever it tells of its steps: anybody can tell them
        if lease.upload_pending_since is not None:
            return math.inf if now - lease.upload_pending_since > UPLOAD_SECONDS else 0.0
        if lease.steps is None:
            return (
                0.0
                if lease.is_background or not taker.host_stats.has_history
                else _overdue_seconds(holder, lease, known, now)
            )
        left = (
            _seconds_until_due(holder, lease, now) if holder.host_stats.has_history and not lease.is_background else 0.0
        )
        if holder.slot_steps_per_second and taker.slot_steps_per_second and self._typical_steps:
            since = holder.slot_steps_per_second * (now - lease.steps_seen_at)
            steps = max(self._typical_steps - lease.steps - since, self._typical_steps / 10)
            left = max(left, steps / holder.slot_steps_per_second)
        return left


def _has_single_holder(digest: bytes, taker: Member, pending: Mapping[bytes, PendingJobView]) -> bool:
    """Whether a job is in one worker's hands and may be given to another."""
    job = pending.get(digest)
    return job is not None and len(job.holders) == 1 and taker.identity not in job.avoided_workers


def _is_trial_due(taker: Member, now: float) -> bool:
    """Whether it is time to try a worker: at once if it is unknown, else when what is known is old."""
    if taker.trial_copies or taker.background_slots:
        return False
    return not taker.host_stats.has_history or now - taker.host_stats.last_return > max(
        STALE, STALE_TIMES * taker.host_stats.expected_seconds(1)
    )


def _seconds_until_due(holder: Member, lease: Lease, now: float) -> float:
    """Seconds until a job should be back; below 0 if it is late."""
    expected_seconds = holder.host_stats.expected_seconds(lease.group.held_before + lease.group.returned_count + 1)
    return lease.group.given_at + expected_seconds - now


def _overdue_seconds(holder: Member, lease: Lease, known: Sequence[HostStats], now: float) -> float:
    """Seconds until a job that was not seen to run should be back: one that is late, as long again as it is late.

    Of a host of which nothing is known yet no more is expected than of the best that is.
    """
    jobs = lease.group.held_before + lease.group.returned_count + 1
    records = [holder.host_stats] if holder.host_stats.has_history else known
    left = lease.group.given_at + min(host_stats.expected_seconds(jobs) for host_stats in records) - now
    return left if left > 0 else -left
