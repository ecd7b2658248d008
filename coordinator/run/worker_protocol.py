"""The worker protocol of a run: messages become events of the run and its fleet, decisions become messages.

No transport: the service decodes what arrives and sends what is returned. Pages: threats.md.
"""

from dataclasses import asdict

from msgspec.structs import replace

from dreamfleet.common.errors import DreamfleetError, InternalError, NotWritableNowError
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.printable import plural, truncate
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.host_classes import class_from_fingerprint
from dreamfleet.common.protocol.messages import (
    MAX_REASON,
    Heartbeat,
    HelloReply,
    HelloRequest,
    Intervals,
    JobBatch,
    Result,
    ResultBatch,
    UploadPart,
)
from dreamfleet.common.protocol.result_bounds import LONGEST_EPISODE, max_steps, rejection_reason
from dreamfleet.common.schema.validation import MAX_TEXT, to_plain
from dreamfleet.coordinator.dispatch.failures import LONGEST_ERROR
from dreamfleet.coordinator.dispatch.packing import SentBatch
from dreamfleet.coordinator.dispatch.refusals import Refusal
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob
from dreamfleet.coordinator.run.run import Run

WorkerMessage = ResultBatch | Heartbeat | UploadPart


class WorkerProtocol:
    """Serves the workers of one incarnation of a run; `nonce` identifies this coordinator process."""

    def __init__(self, run: Run, name: str, nonce: str, intervals: Intervals) -> None:
        self._run = run
        self._name = name
        self._nonce = nonce
        self._intervals = intervals
        self._fleet = run.fleet
        self._admission = run.admission
        self._collections = run.background_jobs.rollout_collections
        self._horizon = run.settings.task.horizon  # of a scored episode whose job names none
        self._measures = len(run.settings.task.measures)

    def answer_hello(self, request: HelloRequest | None, refusal: Refusal | None, now: float) -> HelloReply:
        """Admit a worker or refuse it; `refusal` says why, if the caller knows a reason already.

        A request of `None` was malformed. No reply exceeds what the schema allows, whatever the request was.
        """
        if request is None or not keys.is_worker_identity(request.worker):
            refusal = Refusal("the request is not a hello", "update dreamfleet on the worker's host")
        elif refusal is None:
            refusal = self._admission.find_refusal(request)
        numbering = 0 if request is None or refusal is not None else self._admission.admit(request, now)
        why, remedy, task = refusal or Refusal("", "")
        return HelloReply(
            accepted=not why,
            protocol_min=keys.PROTOCOL_VERSION,
            protocol_max=keys.PROTOCOL_VERSION,
            package=package_version("dreamfleet") or "unknown",
            run=self._name,
            run_uid=self._run.uid,
            incarnation=self._run.incarnation,
            nonce=self._nonce,
            why=truncate(why, MAX_TEXT),
            remedy=truncate(remedy, MAX_TEXT),
            unannounced_task=task,
            spec={} if why else to_plain(self._run.settings.task),
            intervals={} if why else asdict(self._intervals),
            packages=self._run.settings.packages,
            numbering=numbering,
            share=self._run.fleet_share,
        )

    def handle(self, worker: str, message: WorkerMessage, now: float) -> None:
        """Handle a worker's message; one for another run, or a heartbeat for another coordinator, is dropped."""
        if self._run.state.is_rewound:
            return  # the next incarnation of the coordinator hears it again
        if message.run_uid != self._run.uid:
            self._fleet.dropped["foreign run"] += 1
        elif isinstance(message, ResultBatch):
            self.handle_results(worker, message, now)
        elif isinstance(message, UploadPart):
            self.handle_upload(worker, message, now)
        elif message.nonce == self._nonce:
            self.handle_heartbeat(worker, message, now)

    def handle_heartbeat(self, worker: str, beat: Heartbeat, now: float) -> None:
        """Reconcile what a worker holds, and its class, before it gets more work."""
        self._fleet.handle_heartbeat(worker, beat, now)
        self._admission.update_class(worker, beat.host_class)
        for running in beat.running:
            digest = self._fleet.jobs.digest_of_tag(running.tag)
            work = None if digest is None else self._fleet.jobs.work(digest)
            if work is not None and running.steps > max_steps(self._horizon_of(work)):
                self._fleet.overrun(worker, work.digest)

    def handle_results(self, worker: str, batch: ResultBatch, now: float) -> None:
        """Judge a worker's results; the first accepted result of each job is journalled and counted.

        A result that raises does not keep the others from being counted; then the first such error is raised.
        """
        named = batch.host_class or class_from_fingerprint(batch.fingerprint)  # a job that no slot took has no class
        host_class = self._admission.class_of(named, batch.fingerprint)
        if (why := self._admission.distrust_reason(worker, host_class, batch.fingerprint)) is not None:
            self._fleet.dropped[why] += len(batch.results)
            return
        errors = []
        for each in batch.results:
            work = self._fleet.jobs.work(each.digest)
            try:
                self._handle_result(worker, each, work, batch.fingerprint, host_class, now)
            except DreamfleetError:
                raise
            except Exception as error:
                if work is not None and each.digest not in self._fleet.jobs:
                    raise _half_counted_error(error) from error
                errors.append(error)
        if errors:
            raise errors[0]

    def handle_upload(self, worker: str, part: UploadPart, now: float) -> None:
        """Keep part of a rollout, if the worker holds the job and the run still wants it."""
        uploads, pending = self._collections.uploads, self._fleet.jobs.get(part.digest)
        if pending is None or pending.work.kind != "collect" or worker not in pending.holders:
            uploads.dropped["unwanted upload"] += 1
        else:
            uploads.add(worker, part, now)

    def job_batch(self, batch: SentBatch, *, leave: bool = False, ended: bool = False) -> JobBatch:
        """The message for a batch; with `leave` it asks the worker to leave the run, with `ended` it says why."""
        reason = self._run.state.ended if ended else None
        return JobBatch(
            run_uid=self._run.uid,
            incarnation=self._run.incarnation,
            nonce=self._nonce,
            numbering=batch.numbering,
            number=batch.number,
            vectors=tuple(batch.vectors),
            jobs=tuple(work.job for work in batch.work),
            cancels=tuple(batch.cancels),
            verdicts=tuple(batch.verdicts),
            leave=leave,
            ended=ended,
            why="" if reason is None else truncate(reason.text, MAX_REASON),
        )

    def _handle_result(
        self, worker: str, reported: Result, work: ScoringJob | None, fingerprint: str, host_class: str, now: float
    ) -> None:
        """Judge one result; `work` is the wanted job that it names, `None` if it names none."""
        bounded = fail_if_excessive(reported, self._horizon_of(work), self._measures)
        result: Result | None = bounded
        if work is not None and work.kind == "collect":
            try:
                given = self._fleet.find_job_for_result(worker, bounded)
                result = self._collections.receive(worker, bounded, given)
            except NotWritableNowError as error:  # the worker sends both again
                self._run.wait_until_writable(error)
                result = None
        if result is None:  # its rollout is on its way, or the disk is full
            self._fleet.defer_verdict(worker, reported.digest, now)
            return
        _, accepted = self._fleet.handle_result(worker, result, now, host_class)
        if accepted is not None:
            self._run.record_result(accepted, result, worker, fingerprint, host_class)
        elif self._fleet.checked is not None:
            self._run.verification.record(self._fleet.checked, result, worker)
        self._collections.uploads.forget(reported.digest)

    def _horizon_of(self, work: ScoringJob | None) -> int:
        """The most steps of a job's episode; evaluations drive whole ones, whose length only the task knows."""
        if work is None or work.kind == "evaluate":
            return LONGEST_EPISODE
        return work.job.horizon or self._horizon


def fail_if_excessive(result: Result, horizon: int, measures: int) -> Result:
    """The result, turned into a failure of the job if its numbers would spoil the run's, or lacks `measures` of them.

    `horizon` are the most steps that the job's episode can have.
    """
    steps = min(result.steps, max_steps(horizon))
    if result.fitness is None:
        return replace(result, steps=steps)
    why = rejection_reason(result.fitness, result.steps, result.seconds, horizon)
    if why is None and len(result.measures) != measures:
        why = Failure(
            f"wrong measures: the episode gave {plural(len(result.measures), 'number')} beside its fitness, "
            f"not {measures}",
            "wrong measures",
        )
    return result if why is None else replace(result, fitness=None, steps=steps, error=why, upload=None, measures=())


def _half_counted_error(error: Exception) -> InternalError:
    """The error for a result that is accepted but not counted: the run would wait for it without end."""
    return InternalError(
        f"a result could not be counted ({type(error).__name__}: {truncate(str(error), LONGEST_ERROR)}); nothing is "
        "lost: what was committed is whole, and the run can be continued with --resume"
    )
