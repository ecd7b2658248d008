"""Which worker is given which job. Pure.

R15: the least loaded worker is next, unless it is known to be slower than others. A slower one gets only jobs that it
should return before the others have finished the rest, so a bad worker does not delay a generation. Evaluations for
which the run waits go to the least loaded worker, so that no slot idles.
"""

import heapq
import math
from collections.abc import Collection, Mapping
from functools import cached_property

from dreamfleet.common.protocol.keys import host_of
from dreamfleet.coordinator.dispatch.member import Member
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJob, PendingJobs
from dreamfleet.coordinator.jobs.checks import Check
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob

PEER_RATIO = 1.5  # workers at most this many times slower than the best share jobs evenly with it
REST_FRACTION = 0.8  # a slower worker must return a job within this part of the time that the rest takes
MANY_IDLE = 1_000  # slots: planning for so many takes some 20 ms


class WorkerSelection:
    """Chooses among the members in `shares`, by what they hold, while `waiting` jobs are in the queue.

    `shares` says how much of each member's capacity its jobs take; its owner updates it.
    """

    def __init__(self, members: Mapping[str, Member], shares: Mapping[str, int], waiting: int, now: float) -> None:
        self._members = members
        self._shares = shares
        self._order = {name: number for number, name in enumerate(shares)}
        self._loads = {name: len(members[name].leases) for name in shares}
        self._waiting = waiting
        self._now = now
        self._dependable = {name for name, member in members.items() if is_dependable(member, now)}
        self._jobs = sum(len(members[name].leases) for name in self._dependable)
        self._rates = {name: members[name].host_stats.rate for name in self._dependable}
        self._rate = sum(self._rates.values())
        self._expected_seconds = {
            name: members[name].host_stats.expected_seconds(load + 1) for name, load in self._loads.items()
        }
        full = (
            members[name].host_stats.expected_seconds(len(members[name].leases) + 1)
            for name in self._dependable - shares.keys()
        )
        self._soonest_full = min(full, default=math.inf)  # seconds of the fastest member without credit
        self._late: set[str] = set()  # those that `_queue` lacks
        self._best: dict[int, list[tuple[float, str]]] = {}  # size class of a load -> the two fastest members

    def assign(self, name: str) -> None:
        """Note that this member is given one more job."""
        self._loads[name] += 1
        self._expected_seconds[name] = self._members[name].host_stats.expected_seconds(self._loads[name] + 1)
        self._waiting -= 1
        self._jobs += name in self._dependable
        if name in self._late:
            self._late.discard(name)
            heapq.heappush(self._queue, (self._rank(name), name))

    def pick(self, eligible: Collection[str]) -> str | None:
        """The worker to give the next job to; `None` if it pays to wait for one that is not `eligible` now."""
        if len(eligible) == len(self._shares):
            found = self._first_in_time()
        else:
            found = self._least_loaded([name for name in eligible if self._finishes_in_time(name)])
        return self._soonest(eligible) if found is None else found

    def _first_in_time(self) -> str | None:
        """The least loaded member that returns one more job in time.

        One that would be late stays late until it is given a job itself, so it is not asked before.
        """
        while self._queue:
            rank, name = self._queue[0]
            if name in self._shares and rank != (now := self._rank(name)):
                heapq.heapreplace(self._queue, (now, name))
            elif name in self._shares and self._finishes_in_time(name):
                return name
            else:
                heapq.heappop(self._queue)
                self._late.add(name)
        return None

    @cached_property
    def _queue(self) -> list[tuple[tuple[float, float, int], str]]:
        """A heap of the members with credit by rank; a rank in it may be that of an earlier, smaller load."""
        found = [(self._rank(name), name) for name in self._shares]
        heapq.heapify(found)
        return found

    def _rank(self, name: str) -> tuple[float, float, int]:
        """How loaded a member is; of equal ones the sooner goes first, then the one that joined first."""
        return self._shares[name] / self._members[name].capacity, self._expected_seconds[name], self._order[name]

    def pick_for_background(self, eligible: Collection[str]) -> str | None:
        """The worker to give an evaluation to, for which the run waits; `None` to wait for one that will stay up.

        A slow host takes part: idle slots take over what waits there, and copy what it is late with (R17).
        """
        lasting = [name for name in eligible if name not in self._likely_lost]
        if not lasting:
            others_last = any(m.takes_jobs and name not in self._likely_lost for name, m in self._members.items())
            return None if others_last else self._least_loaded(eligible)
        return self._least_loaded(lasting)

    def _least_loaded(self, names: Collection[str]) -> str | None:
        return min(names, key=self._rank, default=None)

    @cached_property
    def _likely_lost(self) -> set[str]:
        """Members that may well be lost before they return one job."""
        return {
            name
            for name, each in self._members.items()
            if each.host_stats.is_likely_lost(1, self._now - each.joined_at)
        }

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
        return jobs / max(self._rate - self._rates[name], 1e-9)

    def _best_other_seconds(self, name: str) -> float:
        """Seconds in which the fastest other worker returns about as many jobs as this one holds."""
        size = self._loads[name].bit_length()
        if size not in self._best:
            records = ((self._members[other].host_stats.expected_seconds(2**size), other) for other in self._dependable)
            self._best[size] = sorted(records)[:2]
        return next(seconds for seconds, other in self._best[size] if other != name)


class JobAssignment:
    """The work that each member is given at one moment, and who may be given more.

    `working_hosts` are those that have scored, `for_suspects` those that may be given suspects; empty: any host.
    """

    def __init__(
        self, jobs: PendingJobs, members: Mapping[str, Member], working_hosts: Collection[str],
        for_suspects: Collection[str],
    ) -> None:  # fmt: skip
        self.given: dict[str, list[ScoringJob]] = {}
        self.shares = {name: member.held_share for name, member in members.items() if member.credit > 0}
        self._full_at = {name: share + members[name].credit for name, share in self.shares.items()}
        self._idle = {name for name, share in self.shares.items() if share < members[name].capacity}
        self._jobs = jobs
        self._members = members
        self._working_hosts = working_hosts
        self._for_suspects = for_suspects

    @property
    def has_idle(self) -> bool:
        """Whether a member with credit has a slot without a job."""
        return bool(self._idle)

    @property
    def idle_slots(self) -> int:
        """Slots without a job of the members with credit."""
        return sum(self._members[name].capacity - self.shares[name] for name in self._idle)

    def give(self, digest: bytes, name: str, *, by_share: bool = False) -> None:
        """Give a job to a member."""
        work = self._jobs[digest].work
        self.given.setdefault(name, []).append(work)
        self._jobs.add_holder(digest, name, by_share=by_share)
        if name in self.shares:
            self.shares[name] += self._members[name].share_of(work.job)
            if self.shares[name] >= self._members[name].capacity:
                self._idle.discard(name)
            if self.shares[name] >= self._full_at[name]:
                del self.shares[name]

    def give_checks(self) -> None:
        """Give jobs whose accepted results another host is to repeat, each to the least loaded one that may (R32)."""
        for pending in [each for each in self._jobs.checks.values() if not each.holders]:
            able = [name for name, member in self._members.items() if self._may_check(pending, member)]
            self._give_to_least_loaded(pending, able)

    def give_copy(self, digest: bytes, first: str) -> None:
        """Give a job that is to be checked to a second host of the class at once, so that nobody waits for it later.

        R32: both get it in its turn, so its place says nothing.
        """
        check = Check(self._members[first].host_class, {self._jobs.voter_of(first)})
        if not self._jobs[digest].avoided_workers:
            able = [
                name for name in self.shares if check.may_ask(self._jobs.voter_of(name), self._members[name].host_class)
            ]
            self._give_to_least_loaded(self._jobs[digest], able)

    def _give_to_least_loaded(self, pending: PendingJob, able: Collection[str]) -> None:
        if able:
            name = min(able, key=lambda name: self._load(name) / self._members[name].capacity)
            self.give(pending.work.digest, name)

    def _may_check(self, pending: PendingJob, member: Member) -> bool:
        check, load = pending.check, self._load(member.identity) - member.held_share
        may = check is not None and check.may_ask(self._jobs.voter_of(member.identity), member.host_class)
        has_room = member.can_score and member.check_credit > load
        return may and has_room and member.identity not in pending.avoided_workers

    def _load(self, name: str) -> int:
        """How much of a member's capacity its jobs take, those that it is given now included."""
        member = self._members[name]
        return member.held_share + sum(member.share_of(work.job) for work in self.given.get(name, ()))

    def find_eligible(self, pending: PendingJob) -> Collection[str]:
        """The members with credit that may be given a job.

        R8: a suspect goes to hosts that have scored, if any, and to no worker that holds another. A job that was scored
        before goes to hosts that have not scored, if one is here: it is to show whether they can. No job goes to a
        worker where it failed, unless every present one is such: then to those where it failed least often. A process
        that was killed once must not stop the run. An unknown sender's hello cannot keep a failed job from being tried
        again, and neither can a worker that was never ready, so unconfirmed workers and these do not count.
        """
        free: Collection[str] = self.shares
        allowed = self._allowed_members(pending)
        if allowed is not self._members or pending.is_suspect:
            busy = self._jobs.holders_of_suspects() if pending.is_suspect else ()
            free = [name for name in free if name in allowed and name not in busy]
        avoided = pending.avoided_workers
        if not avoided:
            return free
        if eligible := [name for name in free if name not in avoided]:
            return eligible
        if any(name not in avoided for name, member in allowed.items() if member.has_been_ready):
            return []
        failed = pending.attempts_by_worker
        fewest = min((failed.get(name, 0) for name in free), default=0)
        return [name for name in free if failed.get(name, 0) == fewest]

    def _allowed_members(self, pending: PendingJob) -> Mapping[str, Member]:
        if pending.is_suspect and self._for_suspects:
            return {name: each for name, each in self._members.items() if host_of(name) in self._for_suspects}
        if pending.is_control:
            new = {name: each for name, each in self._members.items() if host_of(name) not in self._working_hosts}
            return new if any(each.takes_jobs for each in new.values()) else self._members
        return self._members


def assign_jobs(
    jobs: PendingJobs, members: Mapping[str, Member], working_hosts: Collection[str], for_suspects: Collection[str],
    now: float, *, drain_background: bool,
) -> dict[str, list[ScoringJob]]:  # fmt: skip
    """Take queued jobs one by one and choose a member with credit for each; the work by member.

    `working_hosts` and `for_suspects` are those of a `JobAssignment`. With `drain_background` background jobs may use
    all slots. A job without a suitable member stays queued. Where very many slots are idle, they alone get jobs, so
    that they begin sooner; the next turn gives what workers hold in advance.
    """
    assignment = JobAssignment(jobs, members, working_hosts, for_suspects)
    assignment.give_checks()
    shares = assignment.shares
    selection = WorkerSelection(members, shares, jobs.queue_length, now)
    slots = sum(member.slots for member in members.values() if member.takes_jobs)
    passed_over = []
    is_large = assignment.idle_slots >= MANY_IDLE
    while shares and (assignment.has_idle or not is_large):
        if (found := jobs.next(slots, idle=assignment.has_idle, drain_background=drain_background)) is None:
            break
        digest, by_share = found
        pending = jobs[digest]
        eligible = assignment.find_eligible(pending)
        if not eligible:
            passed_over.append(digest)
            continue
        awaited = drain_background and pending.is_background
        name = selection.pick_for_background(eligible) if awaited else selection.pick(eligible)
        if name is None and eligible is shares and not pending.is_control:  # else the faster one may not be given it
            passed_over.append(digest)
            break  # the jobs after it wait for a faster worker too
        name = name or min(eligible, key=lambda name: shares[name])
        selection.assign(name)
        assignment.give(digest, name, by_share=by_share)
        if jobs.is_drawn(pending.work) and not pending.is_suspect and not pending.is_control:
            assignment.give_copy(digest, name)
    for digest in passed_over:
        jobs.enqueue(digest)
    return assignment.given


def is_dependable(member: Member, now: float) -> bool:
    """Whether a worker takes jobs, has returned some before, has slots for candidates and will likely stay up."""
    return (
        member.takes_jobs
        and member.host_stats.has_history
        and member.background_slots < member.slots
        and not member.host_stats.is_likely_lost(1, now - member.joined_at)
    )
