"""What passes between a run and its workers: who may join, what they say, what they are given. No transport."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import replace

from dreamfleet.common.errors import DreamfleetError, InternalError
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.host_classes import HostClasses, effective_class
from dreamfleet.common.protocol.messages import Heartbeat, HelloRequest, Job, Kind, Result, ResultBatch, UploadPart
from dreamfleet.common.protocol.result_bounds import LONGEST_EPISODE, max_steps, rejection_reason
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.coordinator.dispatch.admission import RefusedWorkers, class_mismatch, find_refusal
from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.dispatch.member import Member
from dreamfleet.coordinator.dispatch.packing import OutgoingBatch
from dreamfleet.coordinator.dispatch.pending_jobs import LONGEST_ERROR, JobFailure
from dreamfleet.coordinator.jobs.work import Work
from dreamfleet.coordinator.run.background_jobs import BackgroundJobs
from dreamfleet.coordinator.storage.journal import FINGERPRINT, HOST_CLASS, Journal


class WorkerProtocol:
    """One incarnation's fleet as the service and the status see it; `score` takes accepted results of candidates."""

    def __init__(
        self,
        journal: Journal,
        incarnation: int,
        fleet: Fleet,
        background_jobs: BackgroundJobs,
        score: Callable[[Result], None],
        *,
        horizon: int,
        strict: bool = False,
    ) -> None:
        self.refused_workers = RefusedWorkers()
        # Of the first accepted result; `None` before it.
        self.fingerprint, self.host_class = journal.fingerprint(), journal.host_class()
        self._horizon = horizon  # of a scored episode whose job names none
        self.strict = strict  # no other class counts
        self._journal = journal
        self._incarnation = incarnation
        self._fleet = fleet
        self._background_jobs = background_jobs
        self._uploads = background_jobs.rollout_collections.uploads
        self._score = score

    def find_refusal(self, request: HelloRequest, settings: RunSettings) -> tuple[str, str] | None:
        """Why a worker cannot join and what to do about it; `None` if it may."""
        admitted = self.host_class if self.strict else None
        found = find_refusal(request, settings.task.task, admitted, settings.packages)
        known = request.packages == settings.packages  # else it says hello again
        if found is not None and known and self.refused_workers.add(request.worker, found[0]):
            self._fleet.notes.append(f"refused worker {request.worker}: {found[0]}")
        return found

    def admit(self, request: HelloRequest, now: float) -> int:
        """Welcome a worker; of a strict run its class is compared with the run's once both are known.

        Its batches are counted anew, under the number that is returned.
        """
        self.refused_workers.remove(request.worker)
        known = self._fleet.members.get(request.worker)
        numbering = self._fleet.add_worker(request.worker, request.slots, request.fingerprint, now)
        if (member := self._fleet.members[request.worker]) is not known:
            member.host_class = self._class_of(request.host_class, request.fingerprint)
        return numbering

    def handle_heartbeat(self, worker: str, beat: Heartbeat, now: float) -> None:
        """A worker says what it holds, and of which class its host is: before it is given anything."""
        self._fleet.handle_heartbeat(worker, beat, now)
        member = self._fleet.members.get(worker)
        if member is not None and beat.host_class:
            member.host_class = self._class_of(beat.host_class, member.fingerprint)
            self._enforce_class(member)
        for run in beat.running:
            digest = self._fleet.jobs.digest_of_tag(run.tag)
            work = None if digest is None else self._fleet.jobs.work(digest)
            if work is not None and run.steps > self._most_steps(work.job):
                self._fleet.overrun(worker, work.job.digest)

    def handle_departure(self, worker: str, now: float) -> None:
        """A worker's token vanished."""
        self._fleet.handle_departure(worker, now)

    def handle_results(self, worker: str, batch: ResultBatch, now: float) -> None:
        """Judge a worker's results; the first wanted ones are written and counted.

        One that raises keeps none of the others from being counted; then the first such error is raised.
        """
        host_class = self._class_of(batch.host_class or None, batch.fingerprint)
        if (why := self._distrust_reason(worker, host_class, batch.fingerprint)) is not None:
            self._fleet.dropped[why] += len(batch.results)
            return
        errors = []
        for each in batch.results:
            wanted = each.digest in self._fleet.jobs
            try:
                self._result(worker, each, batch.fingerprint, host_class, now)
            except DreamfleetError:
                raise
            except Exception as error:
                if wanted and each.digest not in self._fleet.jobs:
                    raise _half_counted_error(error) from error
                errors.append(error)
        if errors:
            raise errors[0]

    def _result(self, worker: str, said: Result, fingerprint: str, host_class: str, now: float) -> None:
        work = self._fleet.jobs.work(said.digest)
        kind, horizon = ("evaluate", None) if work is None else (work.job.kind, work.job.horizon)
        each = fail_if_excessive(said, kind, horizon or self._horizon)
        result = self._background_jobs.rollout_collections.receive(
            worker, each, self._fleet.find_job_for_result(worker, each)
        )
        if result is None:
            self._fleet.defer_verdict(worker, each.digest, now)
            return
        _, work = self._fleet.handle_result(worker, result, now)
        if work is not None:
            self._journal.add_result(work.job, result, worker, fingerprint, self._incarnation, host_class)
            self._adopt_class(host_class, fingerprint)
            self._count(work, result)
        self._uploads.forget(result.digest)

    def upload(self, worker: str, part: UploadPart, now: float) -> None:
        """Take in part of a rollout, from a worker that was given the job and while it is wanted."""
        wanted = self._fleet.jobs.get(part.digest)
        if wanted is None or wanted.work.job.kind != "collect" or worker not in wanted.holders:
            self._uploads.dropped["unwanted upload"] += 1
            return
        self._uploads.add(worker, part, now)

    def remove_worker(self, worker: str) -> None:
        """Forget a worker; one that lives says hello again."""
        self._fleet.remove_worker(worker)

    def tick(self, now: float) -> None:
        """Let time pass: departures, silences, uploads that stopped."""
        self._fleet.tick(now)
        self._uploads.tick(now)

    @property
    def jobs(self) -> int:
        """Jobs that are wanted."""
        return len(self._fleet.jobs)

    @property
    def lease_count(self) -> int:
        """Jobs in workers' hands, copies counted."""
        return self._fleet.lease_count

    def dispatch(self, now: float, *, durable: bool = True) -> list[OutgoingBatch]:
        """Batches to send now; verdicts stay until everything so far is `durable`."""
        return self._fleet.dispatch(now, durable=durable)

    def take_notes(self) -> list[str]:
        """What happened since the last call, for a log."""
        notes, self._fleet.notes = self._fleet.notes, []
        return notes

    @property
    def members(self) -> Collection[Member]:
        """The workers that are known."""
        return self._fleet.members.values()

    @property
    def lost(self) -> Collection[Member]:
        """Workers that vanished without a word in the last minutes and are not back."""
        return [each for name, each in self._fleet.lost.items() if name not in self._fleet.members]

    @property
    def counts(self) -> Counter[str]:
        """What became of jobs, results and batches."""
        return self._fleet.counts

    @property
    def failures(self) -> list[JobFailure]:
        """Wanted jobs that failed somewhere."""
        return self._fleet.jobs.failures

    @property
    def dropped(self) -> Counter[str]:
        """Parts of uploads and results that were dropped, by reason."""
        return self._uploads.dropped + self._fleet.dropped

    def _most_steps(self, job: Job) -> int:
        """Of which a beat can tell while a job runs."""
        return max_steps(LONGEST_EPISODE if job.kind == "evaluate" else job.horizon or self._horizon)

    def _distrust_reason(self, worker: str, host_class: str, fingerprint: str) -> str | None:
        """Why nothing counts that this worker says under this class and fingerprint; `None` if it may.

        A host that cannot add to the run is turned away. But in a worker's name anybody can say anything: what is not
        of the fingerprint that it said hello with, is not its word.
        """
        member = self._fleet.members.get(worker)
        if member is not None and member.fingerprint != fingerprint:
            return "result of another fingerprint than its worker's"
        if self._accepts_class(host_class):
            return None
        if member is not None and not (member.host_class and self._accepts_class(member.host_class)):
            self._remove_foreign_class(worker, host_class, fingerprint)
        return "result of another class than the run's"

    @property
    def classes(self) -> HostClasses:
        """What the accepted results are of."""
        return self._journal.classes

    def _class_of(self, said: str | None, fingerprint: str) -> str:
        """What a host counts as in this run; empty: it is not known yet."""
        return effective_class(said, fingerprint, self.host_class)

    def _accepts_class(self, host_class: str) -> bool:
        """Whether hosts of this class may add to the run."""
        return not self.strict or self.host_class in (None, host_class)

    def _adopt_class(self, host_class: str, fingerprint: str) -> None:
        """The first accepted result's class and fingerprint become the run's, in the transaction that writes it."""
        if self.host_class is not None:
            return
        self.host_class, self.fingerprint = host_class, fingerprint
        self._journal.set_fact(HOST_CLASS, host_class)
        self._journal.set_fact(FINGERPRINT, fingerprint)
        for member in list(self._fleet.members.values()):
            member.host_class = self._class_of(member.host_class, member.fingerprint)
            self._enforce_class(member)

    def _enforce_class(self, member: Member) -> None:
        if member.host_class and not self._accepts_class(member.host_class):
            self._remove_foreign_class(member.identity, member.host_class, member.fingerprint)

    def _remove_foreign_class(self, worker: str, host_class: str, fingerprint: str) -> None:
        """Forget a worker of another class: it hears no more, says hello again, and is told why and what to do.

        Nothing of what it has computed gets a verdict, so that it does not take silence for success.
        """
        why, _ = class_mismatch(self.host_class, host_class, fingerprint)
        self._fleet.remove_worker(worker)
        if self.refused_workers.add(worker, why):
            self._fleet.notes.append(f"worker {worker} must go: {why}")

    def _count(self, work: Work, result: Result) -> None:
        """What an accepted result, which is in the journal, means to whatever asked for it."""
        if work.job.kind == "score":
            self._score(result)
        else:
            self._background_jobs.count(work, result)


def fail_if_excessive(result: Result, kind: Kind, horizon: int) -> Result:
    """The result as it may be judged: one whose numbers would spoil the run's is the job's failure.

    `horizon` is of a scored or kept episode; an evaluation drives whole ones, whose length only the world knows.
    """
    if kind == "evaluate":
        horizon = LONGEST_EPISODE
    steps = min(result.steps, max_steps(horizon))
    if result.fitness is None:
        return replace(result, steps=steps)
    why = rejection_reason(result.fitness, result.steps, result.seconds, horizon)
    return result if why is None else replace(result, fitness=None, steps=steps, error=why, upload=None)


def _half_counted_error(error: Exception) -> InternalError:
    """A job that nobody wants any more and that was not counted would be waited for without end."""
    return InternalError(
        f"a result could not be counted ({type(error).__name__}: {truncate(str(error), LONGEST_ERROR)}); nothing is "
        "lost: what was committed is whole, and the run can be continued with --resume"
    )
