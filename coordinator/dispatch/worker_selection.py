"""Which worker is given which job. Pure.

R15: the least loaded worker is next, unless it is known to be slower than others. A slower one gets only jobs that it
should return before the others have finished the rest, so a bad worker does not delay a generation.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from dreamfleet.coordinator.dispatch.failures import host_of
from dreamfleet.coordinator.dispatch.member import Member
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJob, PendingJobs
from dreamfleet.coordinator.jobs.work import Work

PEER_RATIO = 1.5  # workers at most this many times slower than the best share jobs evenly with it
REST_FRACTION = 0.8  # a slower worker must return a job within this part of the time that the rest takes


class WorkerSelection:
    """Chooses among the members in `loads`, which hold so many jobs, while `waiting` jobs are in the queue."""

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
        self._soonest_full = min(full, default=math.inf)  # seconds of the fastest member without credit
        self._best: dict[int, list[tuple[float, str]]] = {}  # size class of a load -> the two fastest members

    def assign(self, name: str) -> None:
        """Note that this member is given one more job."""
        self._loads[name] += 1
        self._expected_seconds[name] = self._members[name].host_stats.expected_seconds(self._loads[name] + 1)
        self._waiting -= 1
        self._jobs += name in self._dependable

    def pick(self, eligible: Collection[str]) -> str | None:
        """The worker to give the next job to; `None` if it pays to wait for one that is not `eligible` now."""
        suitable = [name for name in eligible if self._finishes_in_time(name)]
        if not suitable:
            return self._soonest(eligible)
        return min(
            suitable, key=lambda name: (self._loads[name] / self._members[name].capacity, self._expected_seconds[name])
        )

    def _soonest(self, eligible: Collection[str]) -> str | None:
        """The fastest dependable worker, if it is eligible and no worker without credit is faster."""
        candidates = self._dependable & self._expected_seconds.keys()
        first = min(candidates, key=self._expected_seconds.__getitem__, default=None)
        return first if first in eligible and self._expected_seconds[str(first)] <= self._soonest_full else None

    def _finishes_in_time(self, name: str) -> bool:
        """Whether this worker should return one more job without delaying the generation."""
        if self._dependable <= {name}:
            return True  # there is no other that would wait for it
        member = self._members[name]
        if name not in self._dependable or member.host_stats.is_likely_lost(
            self._loads[name] + 1, self._now - member.joined_at
        ):
            return False
        return self._expected_seconds[name] <= max(
            PEER_RATIO * self._best_other_seconds(name), REST_FRACTION * self._rest_seconds(name)
        )

    def _rest_seconds(self, name: str) -> float:
        """Seconds that the other workers need for the jobs that they hold and those in the queue."""
        jobs = self._waiting + self._jobs - self._loads[name]
        return jobs / max(self._rate - self._members[name].host_stats.rate, 1e-9)

    def _best_other_seconds(self, name: str) -> float:
        """Seconds in which the fastest other worker returns about as many jobs as this one holds."""
        size = self._loads[name].bit_length()
        if size not in self._best:
            records = ((self._members[other].host_stats.expected_seconds(2**size), other) for other in self._dependable)
            self._best[size] = sorted(records)[:2]
        return next(seconds for seconds, other in self._best[size] if other != name)


def assign_jobs(
    jobs: PendingJobs,
    members: Mapping[str, Member],
    working_hosts: Collection[str],
    now: float,
    *,
    drain_background: bool,
) -> dict[str, list[Work]]:
    """Take queued jobs one by one and choose a member with credit for each; the work by member.

    With `drain_background` background jobs may use all slots. A job without a suitable member stays queued.
    """
    given: dict[str, list[Work]] = {}
    loads = {name: len(member.leases) for name, member in members.items() if member.credit > 0}
    selection = WorkerSelection(members, loads, jobs.queue_length, now)
    slots = sum(member.slots for member in members.values() if member.takes_jobs)
    passed_over = []
    while loads:
        idle = any(load < members[name].capacity for name, load in loads.items())
        if (next_job := jobs.next(slots, idle=idle, drain_background=drain_background)) is None:
            break
        pending = jobs[next_job.digest]
        free = _without_suspects(loads, jobs, working_hosts) if pending.is_suspect else loads
        eligible = _eligible_workers(pending, free, members)
        if not eligible:
            passed_over.append(next_job.digest)
            continue
        name = selection.pick(eligible)
        if name is None and not pending.avoided_workers:
            passed_over.append(next_job.digest)
            break  # the jobs after it wait for a faster worker too
        name = name or min(eligible, key=lambda name: loads[name])
        selection.assign(name)
        given.setdefault(name, []).append(pending.work)
        jobs.add_holder(next_job.digest, name, by_share=next_job.by_share)
        loads[name] += 1
        if len(given[name]) >= members[name].credit:
            del loads[name]
    for digest in passed_over:
        jobs.enqueue(digest)
    return given


def _without_suspects(names: Iterable[str], jobs: PendingJobs, working_hosts: Collection[str]) -> list[str]:
    """Which of these members may be given a suspect.

    R8: those that hold no other one, on hosts that have scored, if there were any.
    """
    busy = jobs.holders_of_suspects()
    return [name for name in names if name not in busy and (not working_hosts or host_of(name) in working_hosts)]


def _eligible_workers(pending: PendingJob, free: Collection[str], members: Mapping[str, Member]) -> list[str]:
    """Which of these `free` members may be given a job.

    R8: not one where it failed, unless every present member is such: then those where it failed least often. A process
    that was killed once must not stop the run. A stranger's hello cannot keep a failed job from being tried again, and
    neither can a worker that was never ready, so guests and these do not count.
    """
    if eligible := [name for name in free if name not in pending.avoided_workers]:
        return eligible
    if any(name not in pending.avoided_workers for name, member in members.items() if member.has_been_ready):
        return []
    failed = Counter(each.worker for each in pending.attempts)
    fewest = min((failed[name] for name in free), default=0)
    return [name for name in free if failed[name] == fewest]


def is_dependable(member: Member, now: float) -> bool:
    """Whether a worker takes jobs, has returned some before, has slots for candidates and will likely stay up."""
    return (
        member.takes_jobs
        and member.host_stats.has_history
        and member.background_slots < member.slots
        and not member.host_stats.is_likely_lost(1, now - member.joined_at)
    )
