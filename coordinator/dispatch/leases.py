"""Who holds which job: a lease stands with its worker and with its job, and both change together here. Pure."""

from collections import Counter
from collections.abc import Iterable

from dreamfleet.coordinator.dispatch.event_log import EventLog
from dreamfleet.coordinator.dispatch.member import DispatchGroup, Lease, Member
from dreamfleet.coordinator.dispatch.pending_jobs import JobState, PendingJob, PendingJobs
from dreamfleet.coordinator.dispatch.speculative_execution import Move
from dreamfleet.coordinator.jobs.checks import Check
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob


class Leases:
    """The leases of `members` on `jobs`; what happens to them is counted in `counts` and logged in `event_log`."""

    def __init__(
        self, jobs: PendingJobs, members: dict[str, Member], event_log: EventLog, counts: Counter[str]
    ) -> None:
        self._jobs = jobs
        self._members = members
        self._event_log = event_log
        self._counts = counts

    def add(self, member: Member, digest: bytes, batch: int, group: DispatchGroup, steps: int | None = None) -> None:
        """Note that a worker has a job, or is sent it in this batch; `steps` are those that it has made already."""
        job = self._jobs[digest].work.job
        lease = Lease(batch, group, job.is_background, bool(job.driven), steps=steps, steps_seen_at=self._event_log.now)
        member.add_lease(digest, lease)
        self._jobs.add_holder(digest, member.identity)

    def may_readopt(self, digest: bytes, identity: str) -> bool:
        """Whether a worker that lists a wanted job gets its lease back.

        R5: only if it may have been given the job. R17: a job has at most two holders.
        """
        pending = self._jobs[digest]
        free = pending.state is not JobState.COPIED and identity not in pending.overrun_by
        return free and self._jobs.may_have_been_given(digest, identity)

    def drop(self, member: Member, digest: bytes, *, counted: bool = False) -> None:
        """End a lease without a valid result; `counted`: what the worker did is counted as redundant already.

        R3: when the last lease of a wanted job ends, the job goes back into the queue.
        """
        lease = member.end_lease(digest)
        if lease is not None and not counted and digest in self._jobs:
            self._jobs.record_lost_steps(digest, member.identity, None if lease.finished else lease.steps or 0)
        if self._jobs.remove_holder(digest, member.identity):
            self._counts["reissued"] += 1
            self._event_log.add("reissued", member.identity, digest)
            self._jobs.enqueue(digest)

    def release(self, member: Member) -> None:
        """End all leases of a worker (R3: each job goes back into the queue)."""
        for digest in list(member.leases):
            self.drop(member, digest)
        member.unconfirmed.clear()
        member.unconfirmed_verdicts = len(member.verdicts)
        member.trial_copies.clear()

    def move(self, move: Move, given: dict[str, list[ScoringJob]]) -> None:
        """Give a job to an idle slot, as a copy or instead of to its former holder; `given` is what is to be sent."""
        if move.donor:
            donor = self._members[move.donor]
            donor.end_lease(move.digest)
            donor.cancels.append(move.digest)
            self._jobs.remove_holder(move.digest, donor.identity)
            self._event_log.add("recalled", donor.identity, move.digest)
        else:
            self._event_log.add("copied", move.taker, move.digest)
        if move.trial:
            self._members[move.taker].trial_copies[move.digest] = DispatchGroup(self._event_log.now, 0)
        self._counts["recalled" if move.donor else "copied"] += 1
        self._jobs.add_holder(move.digest, move.taker)
        given.setdefault(move.taker, []).append(self._jobs[move.digest].work)

    def withdraw(self, digests: Iterable[bytes]) -> None:
        """Want these jobs no more; results that still come are obsolete."""
        for digest in digests:
            if digest in self._jobs:
                self.cancel(self._jobs.remove(digest))

    def cancel(self, pending: PendingJob) -> None:
        """End all leases of a job that is wanted no more.

        R9: each holder gets a cancellation, so nobody works for nothing; except a trial copy, whose duration is wanted.
        """
        digest = pending.work.digest
        for holder in pending.holders:
            member = self._members[holder]
            lease = member.end_lease(digest)
            if lease is not None:
                member.record_superseded(lease, self._event_log.now)
            if digest not in member.trial_copies:
                member.cancels.append(digest)
            self._counts["discarded_steps"] += (lease and lease.steps) or 0

    def check_again(self, pending: PendingJob, check: Check) -> None:
        """Want an accepted job again from hosts that the check may ask; of its holders only these go on."""
        if pending.work.digest in self._jobs:
            self._jobs.remove(pending.work.digest)
        members = self._members
        kept = {name for name in pending.holders if check.may_ask(self._jobs.voter_of(name), members[name].host_class)}
        pending.holders -= kept
        self.cancel(pending)
        self._jobs.offer_check(pending.work, check, kept)
