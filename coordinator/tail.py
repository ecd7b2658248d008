"""The end of a generation: when nothing is left to give, idle slots take over what waits elsewhere. Pure.

First jobs that another worker was given and cannot have begun; then, where it should pay, a second copy of a straggler.
Rule 8 of the protocol.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from dreamfleet.coordinator.jobs import Work
from dreamfleet.coordinator.member import Lease, Member

SMOOTHING = 0.1  # weight of the newest episode in the typical one
QUIET_BEATS = 2  # without a word: a straggler that nothing is known of
UPLOAD_SECONDS = 30.0  # after a result, in which its upload should have come
MARGIN = 1.5  # how many times sooner a copy must be expected to finish


class Wanted(Protocol):
    """What is known of a wanted job."""

    work: Work
    holders: set[str]
    failed: dict[str, str]


@dataclass(frozen=True)
class Move:
    """Give a job to another worker: a copy, or `instead_of` one that has not begun it."""

    digest: bytes
    to: str
    instead_of: str | None = None


class Tail:
    """Plans moves; remembers how long an episode typically is, in steps."""

    def __init__(self, beat: float) -> None:
        self._beat = beat
        self._typical = 0.0

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
        if not idle:
            return
        moved: set[bytes] = set()
        idle.sort(key=lambda member: -member.pace)
        for taker in idle:
            while loads[taker.identity] < taker.capacity:
                move = self._recall(taker, present, loads, wanted, moved) or self._copy(
                    taker, present, wanted, moved, now
                )
                if move is None:
                    break
                moved.add(move.digest)
                loads[taker.identity] += 1
                if move.instead_of:
                    loads[move.instead_of] -= 1
                yield move

    def _recall(
        self,
        taker: Member,
        present: Sequence[Member],
        loads: Mapping[str, int],
        wanted: Mapping[bytes, Wanted],
        moved: set[bytes],
    ) -> Move | None:
        """The job that was given last to whoever has most waiting: more leases than slots means that some wait."""
        donors = [member for member in present if member is not taker and loads[member.identity] > member.capacity]
        for donor in sorted(donors, key=lambda member: -loads[member.identity] / member.capacity):
            for digest, lease in reversed(donor.leases.items()):
                alone = digest in wanted and len(wanted[digest].holders) == 1
                if (
                    alone
                    and lease.steps is None
                    and lease.ended is None
                    and digest not in moved
                    and taker.identity not in wanted[digest].failed
                ):
                    return Move(digest, taker.identity, donor.identity)
        return None

    def _copy(
        self, taker: Member, present: Sequence[Member], wanted: Mapping[bytes, Wanted], moved: set[bytes], now: float
    ) -> Move | None:
        """A straggler that this slot should finish sooner."""
        for holder in present:
            if holder is taker:
                continue
            for digest, lease in holder.leases.items():
                if digest not in wanted or digest in moved:
                    continue
                job = wanted[digest]
                single = len(job.holders) == 1 and taker.identity not in job.failed
                if single and self._straggles(holder, lease, taker, now):
                    return Move(digest, taker.identity)
        return None

    def _straggles(self, holder: Member, lease: Lease, taker: Member, now: float) -> bool:
        quiet = now - holder.heard
        if quiet > QUIET_BEATS * self._beat:
            return True
        if lease.ended is not None:
            return now - lease.ended > UPLOAD_SECONDS
        if lease.steps is None or not (holder.pace and taker.pace and self._typical):
            return False
        left = max(self._typical - lease.steps - holder.pace * quiet, self._typical / 10)
        return left / holder.pace > MARGIN * self._typical / taker.pace
