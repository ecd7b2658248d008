"""At the end of a generation, when the queue is empty, idle slots help other workers. Pure.

R17: an idle slot first takes a job that waits elsewhere; then it copies a straggler, if that should pay. R16: a worker
without a recent record, beside one with a record, first gets a trial copy of a job, for which nobody waits.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from dreamfleet.coordinator.dispatch.host_stats import HostStats
from dreamfleet.coordinator.dispatch.member import Lease, Member
from dreamfleet.coordinator.dispatch.pending_jobs import JobState, PendingJobs
from dreamfleet.coordinator.dispatch.worker_selection import is_dependable
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob

SMOOTHING = 0.1  # weight of the newest episode in the typical one
QUIET_INTERVALS = 2  # heartbeat intervals without a message after which a holder's jobs may be copied
UPLOAD_SECONDS = 30.0  # after its result, within which an upload should arrive
MARGIN = 1.5  # a copy must be expected to finish this many times sooner
# A job held longer than so many seconds and so many typical times may be copied, whatever progress its worker reports.
LONGEST_HELD, LONGEST_HELD_TIMES = 60.0, 8.0  # docs/explanation/threats.md
STALE, STALE_TIMES = 10.0, 20.0  # seconds, and turnarounds, after which a host's record is too old
Straggler = tuple[float, bytes, Member]  # the seconds that a job's holder still needs, the job's digest, the holder


@dataclass(frozen=True)
class Move:
    """Give the job `digest` to an idle slot of `taker`: from `donor`, which has not begun it, or else as a copy."""

    digest: bytes
    taker: str
    donor: str | None = None
    trial: bool = False  # a copy that only measures the taker


class SpeculativeExecution:
    """Plans moves of `jobs` to idle slots of `members`, from the typical length and duration of accepted jobs."""

    def __init__(self, heartbeat_interval: float, jobs: PendingJobs, members: Mapping[str, Member]) -> None:
        self._heartbeat_interval = heartbeat_interval
        self._jobs = jobs
        self._members = members
        self._typical_steps = 0.0  # of an episode
        self._typical_seconds = {False: 0.0, True: 0.0}  # from giving a job to its result, by whether it is background

    def record_duration(self, seconds: float, *, is_background: bool) -> None:
        """Note how long an accepted job was with its worker, by the coordinator's clock."""
        before = self._typical_seconds[is_background]
        self._typical_seconds[is_background] += SMOOTHING * (seconds - before) if before else seconds

    def longest_held(self, *, is_background: bool) -> float:
        """Seconds after which a job has been away for too long, whatever progress its worker reports."""
        return LONGEST_HELD + LONGEST_HELD_TIMES * self._typical_seconds[is_background]

    def record_episode(self, steps: int) -> None:
        """Note the length of an accepted episode."""
        self._typical_steps += SMOOTHING * (steps - self._typical_steps) if self._typical_steps else steps

    def plan(self, given: Mapping[str, Sequence[ScoringJob]], now: float) -> Iterator[Move]:
        """Moves to the idle slots, the fastest member first; `given` is the work that is about to be sent.

        R17: an idle slot helps with what other workers hold, so the last jobs of a generation end sooner.
        """
        takers = [member for member in self._members.values() if member.takes_jobs]
        loads = {
            each.identity: each.held_share + sum(each.share_of(work.job) for work in given.get(each.identity, ()))
            for each in takers
        }
        idle = [member for member in takers if loads[member.identity] < member.free_capacity]
        moved: set[bytes] = set()
        stragglers: dict[tuple[bool, bool], list[Straggler]] = {}
        for taker in sorted(
            idle, key=lambda member: (member.host_stats.expected_seconds(1), -member.slot_steps_per_second)
        ):
            for move in self._moves(taker, takers, loads, moved, stragglers, now):
                moved.add(move.digest)
                job = self._jobs[move.digest].work.job
                loads[taker.identity] += taker.share_of(job)
                if move.donor:
                    loads[move.donor] -= self._members[move.donor].share_of(job)
                yield move

    def _moves(
        self, taker: Member, members: Sequence[Member], loads: Mapping[str, int], moved: set[bytes],
        stragglers: dict[tuple[bool, bool], list[Straggler]], now: float,
    ) -> Iterator[Move]:  # fmt: skip
        """Moves to one member until its slots are full; `stragglers` are those that other takers found."""
        others = [member for member in members if member is not taker]
        if not taker.host_stats.has_history and any(is_dependable(other, now) for other in others):
            return  # a trial copy measures it first
        known = taker.host_stats.has_history, taker.slot_steps_per_second > 0
        if known not in stragglers:
            stragglers[known] = self._stragglers(members, taker, now)
        while loads[taker.identity] < taker.free_capacity:
            jobs_held = len(taker.leases) + loads[taker.identity] - taker.held_share
            expected = self._expected_seconds(taker, jobs_held + 1)
            move = self._find_recall(taker, expected, others, loads, moved, now)
            if move is None and (copied := self._find_straggler(stragglers[known], taker, expected, moved)) is not None:
                move = Move(copied, taker.identity)
            if move is None:
                return
            yield move

    def _expected_seconds(self, taker: Member, jobs: int) -> float:
        if not taker.host_stats.has_history and taker.slot_steps_per_second and self._typical_steps:
            return self._typical_steps / taker.slot_steps_per_second
        return taker.host_stats.expected_seconds(jobs)

    def plan_trials(self, busy: Collection[str], now: float) -> Iterator[Move]:
        """One trial copy for each idle member without a recent record, if another one has a record.

        R16: a member is measured on a job for which nobody waits, before anything depends on it.
        """
        takers = [member for member in self._members.values() if member.takes_jobs]
        for taker in takers:
            if taker.leases or not taker.free_capacity or taker.identity in busy or not _is_trial_due(taker, now):
                continue
            known = [other for other in takers if other is not taker and is_dependable(other, now)]
            donors = sorted(known, key=lambda member: -len(member.leases) / member.capacity)
            copied = (digest for donor in donors for digest, lease in reversed(donor.leases.items())
                      if not lease.is_background and self._may_take(digest, taker))  # fmt: skip
            if (digest := next(copied, None)) is not None:
                yield Move(digest, taker.identity, trial=True)

    def _find_recall(
        self, taker: Member, expected: float, others: Sequence[Member], loads: Mapping[str, int], moved: set[bytes],
        now: float,
    ) -> Move | None:  # fmt: skip
        """The latest job of the most loaded member with more leases than free slots: it waits there, not begun."""
        donors = [member for member in others if loads[member.identity] > member.free_capacity]
        for donor in sorted(donors, key=lambda member: -loads[member.identity] / member.capacity):
            for digest, lease in reversed(donor.leases.items()):
                waits = lease.steps is None and lease.upload_pending_since is None and digest not in moved
                if waits and self._may_take(digest, taker):
                    known = taker.host_stats.has_history and donor.host_stats.has_history
                    if known and _seconds_until_due(donor, lease, now) <= expected and not donor.background_slots:
                        break  # its holder should return it sooner
                    return Move(digest, taker.identity, donor.identity)
        return None

    def _stragglers(self, members: Sequence[Member], taker: Member, now: float) -> list[Straggler]:
        """Leases with the seconds that their holder still needs; the longest first.

        They are the same for all takers with a record, or without, and whose speed is known, or is not.
        """
        known = [member.host_stats for member in members if member.host_stats.has_history]
        found = [
            (self._remaining_seconds(holder, lease, taker, known, now), digest, holder)
            for holder in members
            for digest, lease in holder.leases.items()
        ]
        return sorted(found, key=lambda each: -each[0])

    def _remaining_seconds(
        self, holder: Member, lease: Lease, taker: Member, known: Sequence[HostStats], now: float
    ) -> float:
        """Seconds that the holder of a job still needs; of two estimates the longer. Infinite: copy it in any case."""
        if now - holder.last_heard > QUIET_INTERVALS * self._heartbeat_interval:
            return math.inf
        if now - lease.group.given_at > self.longest_held(is_background=lease.is_background):
            return math.inf
        if lease.upload_pending_since is not None:
            return math.inf if now - lease.upload_pending_since > UPLOAD_SECONDS else 0.0
        if lease.steps is None:
            measured = not lease.is_background and taker.host_stats.has_history
            return _overdue_seconds(holder, lease, known, now) if measured else 0.0
        left = 0.0
        if holder.host_stats.has_history and not lease.is_background:
            left = _seconds_until_due(holder, lease, now)
        if holder.slot_steps_per_second and taker.slot_steps_per_second and self._typical_steps:
            since = holder.slot_steps_per_second * (now - lease.steps_seen_at)
            steps = max(self._typical_steps - lease.steps - since, self._typical_steps / 10)
            left = max(left, steps / holder.slot_steps_per_second)
        return left

    def _find_straggler(
        self, stragglers: Sequence[Straggler], taker: Member, expected: float, moved: Collection[bytes]
    ) -> bytes | None:
        """The job of another worker that `taker` should copy, as it would need `expected` seconds; `None`: none.

        `stragglers` begin with the longest.
        """
        for left, digest, holder in stragglers:
            if left <= MARGIN * expected and left != math.inf:
                break
            if holder is not taker and digest not in moved and self._may_take(digest, taker):
                return digest
        return None

    def _may_take(self, digest: bytes, taker: Member) -> bool:
        """Whether a job has one holder and may be given to `taker`.

        R17: a job has at most two holders, which bounds the wasted work. R8: what may have ended its workers has one,
        and so has a job that is to show whether its holder can score.
        """
        job = self._jobs.get(digest)
        if job is None or job.is_suspect or job.is_control:
            return False
        if job.check is not None and not job.check.may_ask(self._jobs.voter_of(taker.identity), taker.host_class):
            return False
        return job.state is JobState.LEASED and taker.identity not in job.avoided_workers


def _is_trial_due(taker: Member, now: float) -> bool:
    """Whether to measure a member: at once if its host has no record, else when the record is old."""
    if taker.trial_copies or taker.background_slots:
        return False
    return not taker.host_stats.has_history or now - taker.host_stats.last_return > max(
        STALE, STALE_TIMES * taker.host_stats.expected_seconds(1)
    )


def _seconds_until_due(holder: Member, lease: Lease, now: float) -> float:
    """Seconds until a job should be back; negative if it is late."""
    expected = holder.host_stats.expected_seconds(lease.group.held_before + lease.group.returned_count + 1)
    return lease.group.given_at + expected - now


def _overdue_seconds(holder: Member, lease: Lease, known: Sequence[HostStats], now: float) -> float:
    """Seconds until a job that no heartbeat has shown running should be back; a late one takes as long again.

    A holder without a record is expected to be as fast as the best host with one.
    """
    jobs = lease.group.held_before + lease.group.returned_count + 1
    records = [holder.host_stats] if holder.host_stats.has_history else known
    left = lease.group.given_at + min(host_stats.expected_seconds(jobs) for host_stats in records) - now
    return left if left > 0 else -left
