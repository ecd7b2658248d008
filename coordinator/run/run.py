"""One incarnation of a run: it owns the fleet, the journal and the optimiser's generations. Knows no transport.

Everything that happens is durable before a worker hears that it counts: `commit` comes before the verdicts. The jobs
of a generation may be sent before it is durable: a coordinator that dies in between asks for the same population again.
"""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from math import nan

from msgspec.structs import replace

from dreamfleet.common.errors import NotWritableNowError
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.protocol.messages import Job, Result
from dreamfleet.common.protocol.stop_kind import PauseKind, StopReason
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_folder import EPISODE_LIMIT
from dreamfleet.common.runs.stages import StageTracker
from dreamfleet.coordinator.dispatch.event_log import Note
from dreamfleet.coordinator.dispatch.failures import LONGEST_ERROR
from dreamfleet.coordinator.dispatch.fleet import CLOCK_GAP, Fleet
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJob
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob
from dreamfleet.coordinator.run.admission import WorkerAdmission
from dreamfleet.coordinator.run.background_jobs import BackgroundJobs
from dreamfleet.coordinator.run.external_generations import ExternalGenerations
from dreamfleet.coordinator.run.failure_policy import FailurePolicy
from dreamfleet.coordinator.run.generations import Generations
from dreamfleet.coordinator.run.recall import BAR_BY_OPERATOR, find_bar_problem, recall, unbar_words
from dreamfleet.coordinator.run.run_state import Pause, Running, RunState
from dreamfleet.coordinator.run.stop_reason import find_stop_reason, store_reason, stored_reason
from dreamfleet.coordinator.run.verification import Verification
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.storage.journal import Journal

PAUSED = "paused"  # the fact that somebody paused the run
BY_HAND = Pause(PauseKind.BY_HAND, "by hand")  # docs/reference/status.md
WRITE_RETRY = 2.0  # seconds until a full disk or a locked journal is tried again


class Run:
    """One incarnation of a run, new or continued; `network` says how it treats its workers."""

    def __init__(
        self, journal: Journal, settings: RunSettings, limits: LimitsConfig, network: NetworkConfig, now: float,
        host_key: bytes = b"", *, is_secured: bool = False,
    ) -> None:  # fmt: skip
        """`host_key` is the key of this host, by which workers on it show that they are (R32)."""
        self.journal = journal  # whose only writer is the thread of this run
        self.settings = settings
        self.limits = limits
        self.fleet = Fleet(network.beat, network.evaluation_share)
        self.fleet_share = network.share
        self._now = now
        self.uid = journal.fact("uid") or ""
        self.created = journal.fact("created") or ""  # ISO 8601, UTC
        limit = journal.fact(EPISODE_LIMIT)
        self.episode_limit = None if limit is None else int(limit)  # steps; of the environment itself, if it is known
        self.incarnation = journal.begin_incarnation()
        journal.commit()
        self._notes: list[Note] = []  # that are in the journal and not in the log
        self.admission = WorkerAdmission(
            journal, settings, self.fleet, strict=network.strict, host_key=host_key, is_secured=is_secured
        )
        self.verification = Verification(journal, self.fleet, self.admission, network.verify, self.incarnation)
        reached = stored_reason(journal, limits)
        self.state: RunState = Running() if reached is None else Running().reach_limit(reached)
        closed, evaluations = journal.read_closed()
        self.history = History(closed)
        self._agenda = StageTracker(settings)
        self.background_jobs = BackgroundJobs(
            journal, settings, self.uid, self.history, evaluations, self._agenda, self.verification
        )
        evaluated = self.background_jobs.evaluations.finished
        kind = ExternalGenerations if settings.is_external else Generations
        self.generations = kind(journal, settings, self._agenda, self.history, evaluated)
        self.failure_policy = FailurePolicy(journal, self.fleet, self.generations, settings, network.failure_limit)
        self.generation = self.generations.begin()
        self.open_seconds = self.generations.seconds  # in which the open generation could be scored
        self.fleet.failure_judge.working_hosts.update(map(host_of, journal.results.workers()))
        if self.incarnation > 1:  # the last incarnation may have sent the next generation's jobs before it was durable
            self.fleet.jobs.given_before_until = self.generation.number + 1
        self._begin(now)

    @property
    def dropped(self) -> Counter[str]:
        """Results, heartbeats and parts of uploads that were dropped, by reason."""
        return self.background_jobs.rollout_collections.uploads.dropped + self.fleet.dropped

    def _enter(self, state: RunState) -> None:
        """The only place where the state changes."""
        self.state, self.fleet.paused = state, not state.gives_jobs

    def record_result(self, work: ScoringJob, result: Result, worker: str, fingerprint: str, host_class: str) -> None:
        """Journal an accepted result, then count it for the generation or the background job that wants it."""
        self.journal.results.add(work.job, result, worker, fingerprint, self.incarnation, host_class)
        self.admission.adopt_class(host_class, fingerprint)
        self.verification.note_accepted(work.job, result, worker)
        assert result.fitness is not None
        self._count(work.job, result.fitness, result.steps, result.measures)

    def _count(self, job: Job, fitness: float, steps: int, measures: Sequence[float] = ()) -> None:
        """Count a result that is in the journal; `fitness` is NaN for an episode that failed for good."""
        if job.kind != "score":
            self.background_jobs.count(job, fitness)
        elif self.generation.record(job.digest, fitness, steps, measures):  # it wants other jobs now
            self.verification.restore(self.generation.counted)
            self.fleet.jobs.offer(self.generation.missing)

    def tick(self, now: float) -> None:
        """Let time pass: departed workers, silent workers, stalled uploads, and the generation's own time."""
        since, self._now = self._now, now
        self.fleet.tick(now)
        if self.generation.population and self.state.gives_jobs and self.fleet.has_workers:
            self.open_seconds += min(now - since, CLOCK_GAP)
        self.background_jobs.rollout_collections.uploads.tick(now)

    def advance(self, now: float) -> bool:
        """Close the complete generation and open the next one; whether a generation was opened."""
        closed = len(self.history)
        state = self.state
        if state.is_rewound or state.stalled or (self.generation.complete and not self._take_lock()):
            return False
        if self.generation.unmade and state.reached is None:  # first, for others judge by the open jobs
            self.fleet.jobs.offer(self.generation.make_more())
        self._settle_failures()
        self.verification.settle(now)
        if self.verification.has_findings:
            if not self.state.is_leaving and self._take_lock():  # the next incarnation has the same checked again
                self._rewind(self.verification.condemn)
            return False
        self.background_jobs.settle()
        has_opened = self._open_batch()
        while self.state.gives_jobs and self.generation.complete and not self._is_waiting:
            if self.verification.holds_generation:
                break
            reseeds = self.generations.can_reseed(self.generation)
            if not reseeds and (excess := self.failure_policy.find_excess(self.generation)) is not None:
                self.pause(excess)
            elif (note := self.generations.try_again(self.generation)) is not None:
                self.fleet.note(note, "reseeded")
                self._replace_generation(self.generations.reload(self.generation.number))
            else:
                self._close(now)
        self.fleet.drain_background = self._is_waiting
        self.fleet.jobs.unmade = self.generation.unmade if self.state.reached is None else 0
        self._finish()
        return has_opened or len(self.history) > closed

    def commit(self) -> bool:
        """Make everything so far durable, then write the reported controller if it is due; whether that succeeded.

        On a full disk or a locked journal the run waits: it gives out no jobs and closes no generation until a later
        call succeeds.
        """
        stalled = self.state.stalled
        if stalled is None and self.journal.has_writes:
            self.journal.set_seconds(self.generation.number, self.open_seconds)
        elif stalled is not None and self._now < stalled.retry_at:
            return False
        try:
            self.journal.commit()
            if not self.state.is_rewound:
                self.background_jobs.report.save()
        except NotWritableNowError as error:
            self.wait_until_writable(error)
            return False
        if stalled is not None:
            self._enter(self.state.recover())
            paused = self.state.paused
            goes_on = "the run continues" if paused is None else f"the run stays paused: {paused.text}"
            self.fleet.note(f"the journal can be written again: {goes_on}", "written")
        return True

    def _take_lock(self) -> bool:
        """Take the journal's lock before changes that nothing may interrupt; whether that succeeded."""
        try:
            self.journal.take_lock()
        except NotWritableNowError as error:
            self.wait_until_writable(error)
            return False
        return True

    def wait_until_writable(self, error: NotWritableNowError) -> None:  # docs/how-to/unattended.md
        """Give out no jobs until what could not be written is written."""
        why = f"{error}, and the run then continues by itself"  # docs/how-to/troubleshooting.md
        if self.state.stalled is None:
            self.fleet.note(f"paused: {why}", "paused")
        self._enter(self.state.stall(why, self._now + WRITE_RETRY))

    def leave(self) -> None:
        """Make everything durable and write the reported controller before the coordinator exits."""
        self._write_notes()
        self.journal.end_incarnation()
        self.journal.set_seconds(self.generation.number, self.open_seconds)
        self.journal.commit()
        if self.state.stalled is not None:
            self._enter(self.state.recover())
        if not self.state.is_rewound:
            self.background_jobs.report.save(at_once=True)

    def keep_paused(self) -> bool:
        """Stay paused if the coordinator is started again before somebody resumes the run; whether that is durable."""
        self.journal.set_fact(PAUSED, BY_HAND.text)  # kept until it can be written
        return self.commit()

    def pause(self, pause: Pause) -> None:
        """Stop dispatching until the run is resumed; a run that is over stays so."""
        if self.state.is_over:
            return
        before = self.state.paused
        self._enter(self.state.pause(pause))
        if (paused := self.state.paused) is not None and paused != before:
            self.fleet.note(f"paused: {paused.text}", "paused")

    def resume(self) -> str:
        """Dispatch again; failed jobs may go to any worker again.

        Why the run cannot continue now, in words; empty if it does.
        """
        if not self.state.is_over and self._take_lock():
            if self.state.paused is not None:
                self.fleet.note("resumed", "resumed")
            self._go_on()
            self.verification.resume()
            self.journal.drop_fact(PAUSED)
            self.failure_policy.accept(self.generation.number)
            self.fleet.jobs.offer(self.background_jobs.retry_failed())
            if self.generation.has_failures:
                self.journal.drop_failures(self.generation.number)
                self._replace_generation(self.generations.reload(self.generation.number))
        why = self.obstacle
        return f"it cannot continue now: {why}; repeat `resume` then" if why else ""

    @property
    def obstacle(self) -> str:
        """Why nothing can be changed now, in words; empty if it can."""
        if (stalled := self.state.stalled) is not None:
            return stalled.why
        return "results are being recalled" if self.state.is_rewound else ""

    def _go_on(self) -> None:
        """Dispatch again, what failed too."""
        self._enter(self.state.resume())
        self.fleet.jobs.clear_failures()

    def bar(self, host: str, *, is_barred: bool = True) -> str:
        """Bar a host as the operator says, and take back what it brought (R33); else let it in again.

        Why that is not done, in words; empty if it is, durably.
        """
        if self.state.is_rewound or self.state.stalled or not self._take_lock():
            return f"the run cannot be changed now: {self.obstacle}; ask again"
        known = self.admission.known_hosts()
        if problem := find_bar_problem(host, self.admission.barred, known, is_barred=is_barred):
            return problem
        if is_barred:
            done = self._rewind(lambda: self.admission.bar(host, BAR_BY_OPERATOR, self.incarnation))
            return "" if done else f"it cannot be barred now: {self.obstacle}; ask again"
        self.admission.unbar(host)
        self.fleet.note(unbar_words(host), "unbarred")
        self._write_notes()
        return "" if self.commit() else f"that cannot be written now: {self.obstacle}; it counts once it is written"

    def _rewind(self, bar: Callable[[], Collection[str]]) -> bool:
        """Bar hosts and take back what they brought, in one transaction (R33); whether that is durable.

        If it is not, nothing of it was written, nor what came since the last commit. What the run holds in memory is
        true no more in either case: another incarnation goes on from the journal.
        """
        self.journal.verify(self.journal.path.parent)  # else what somebody wrote into it would be replayed, and sealed
        self._enter(self.state.rewind())
        before = [*self.fleet.notes], [*self._notes]
        try:
            hosts = bar()
            self.fleet.note(recall(self.journal, self.settings, hosts), "recalled")
            self._write_notes()
            self.background_jobs.report.withdraw()
            self.journal.commit()
        except NotWritableNowError as error:
            self.journal.forget_writes()
            self.fleet.notes, self._notes = before  # without that it was done
            self.wait_until_writable(error)
            self._write_notes()  # so that the next commit fails too, until there is room
            return False
        return True

    def _settle_failures(self) -> None:
        """Make lasting failures facts of the run (R8), and pause it where all hosts fail."""
        judge = self.fleet.failure_judge
        if self.failure_policy.judges:
            for lasting in judge.find_lasting():
                self._record_failure(lasting)
        if (paused := self.state.paused) is None:
            if (pause := self.failure_policy.find_pause(self.generation)) is not None:
                self.pause(pause)
        elif paused.until_host and judge.may_recover:
            self.fleet.note("a host has joined that may be able to score: the run continues", "continues")
            self._go_on()

    def _record_failure(self, failure: PendingJob) -> None:
        """Journal that a job's episode fails wherever it is scored; it is wanted no more."""
        job, error = failure.work.job, failure.attempts[-1].error
        self.fleet.leases.withdraw([job.digest])
        error = replace(error, text=truncate(error.text, LONGEST_ERROR))
        self.journal.add_failure(job, error, list(failure.attempts_by_worker), len(failure.attempts))
        self.fleet.note(f"{failure.describe_failure()}; it counts as failed", "given up")
        self._count(job, nan, 0)
        if job.kind == "score":
            self.fleet.leases.withdraw(self.generation.unwanted)

    def _open_batch(self) -> bool:
        """Open the next batch of a run that waits for one; whether one was opened."""
        if self.generation.population or self.state.paused or self.journal.batches.next_waiting() is None:
            return False
        if not self._take_lock():
            return False
        self._begin_generation(self.generations.open(self.generation.number))
        self.fleet.jobs.offer(self.generation.missing)
        return True

    def _begin_generation(self, generation: Generation) -> None:
        self.generation = generation
        self.verification.restore(generation.counted)
        self.open_seconds = 0.0
        self.fleet.jobs.begin_generation(generation.number)

    def _replace_generation(self, generation: Generation) -> None:
        """Score the open generation as it is now: of a race whose first half is open again, nothing of the second."""
        self.generation, missing, counted = generation, generation.missing, generation.counted
        wanted = {each.digest for each in missing}
        self.fleet.leases.withdraw(each for each in self.fleet.jobs.plain_scores() if each not in wanted)
        self.verification.keep_to(counted)
        self.verification.restore(counted)  # what failed candidates have was checked no more
        self.fleet.jobs.offer(missing)

    def take_notes(self) -> list[Note]:
        """What happened since the last call, for the log; the journal keeps it too."""
        self._write_notes()
        notes, self._notes = self._notes, []
        return notes

    def _write_notes(self) -> None:
        for note in self.fleet.notes:
            self.journal.add_event(*note)
            self._notes.append(note)
        self.fleet.notes = []

    @property
    def _is_waiting(self) -> bool:
        """Whether the run is ending, or an evaluation in progress decides the next generation's parameters."""
        deciding = self._agenda.required_evaluation(self.generation.number + 1)
        return self.state.reached is not None or (
            self.background_jobs.evaluations.is_open(deciding) and self.generation.complete
        )

    def _begin(self, now: float) -> None:
        generation = self.generation
        if len(self._agenda) > 1:
            self.fleet.note(f"generation {generation.number} is in {self.generations.stage_text}", "stage")
        self.fleet.jobs.begin_generation(generation.number)
        self.verification.restore(generation.counted)
        work = self.background_jobs.begin(self.generations.mean, now)
        if self.state.reached is None and not generation.done and (reason := self._stop_reason(generation)):
            self._reach_limit(reason)
        if self.journal.fact(PAUSED) is not None:
            self.pause(BY_HAND)
        if self.state.reached is None:
            self.journal.drop_fact("ended")
            self.fleet.jobs.offer([*work, *generation.missing])
        else:
            self.fleet.jobs.offer(work)
            self._finish()
            if self.state.ended is not None:
                self.commit()

    def _close(self, now: float) -> None:
        closed = self.generations.close(self.generation, self.open_seconds)
        mean = self.generations.mean
        # Opened even if the run ends here: a later incarnation with wider limits continues from it.
        generation = self.generations.open(closed.number + 1)
        reason = self._stop_reason(generation)
        self.fleet.jobs.offer(self.background_jobs.schedule(closed.number, mean, now, last=reason is not None))
        if (note := self.generations.stage_note) is not None:
            self.fleet.note(note, "next stage")
        self._begin_generation(generation)
        if reason:
            self.fleet.leases.withdraw(self.fleet.jobs.digests_of_kind("score"))
            self._reach_limit(reason)
        else:
            self.fleet.jobs.offer(generation.missing)

    def _stop_reason(self, generation: Generation) -> StopReason | None:
        if self.settings.is_external:
            return None
        return find_stop_reason(self.limits, self.history, self.background_jobs, generation, self.settings.task)

    def _finish(self) -> None:
        """Once a limit is reached and no background job is left: confirm the reported mean, then end the run."""
        if self.state.reached is None or self.state.is_over:
            return
        if self.background_jobs.in_progress or self.fleet.jobs.checks or not self._take_lock():
            return
        if work := self.background_jobs.confirm():
            self.fleet.note(self.background_jobs.round_description, "confirming")
            self.fleet.jobs.offer(work)
        elif not self.fleet.jobs.checks:  # else results of an earlier incarnation are checked first
            if self.background_jobs.confirmation_failed:
                self.fleet.note("no confirmed score: every episode of the confirmation failed", "unconfirmed")
            self._end()

    def _reach_limit(self, reason: StopReason) -> None:
        self._enter(self.state.reach_limit(reason))
        store_reason(self.journal, self.limits, reason)

    def _end(self) -> None:
        ended = self.state.end()
        self._enter(ended)
        # A new host may still have a job to show itself.
        self.fleet.leases.withdraw(self.fleet.jobs.digests_of_kind("score"))
        self.journal.end(ended.reason.text)
        self._write_notes()
        self.journal.add_event(f"ended: {ended.reason.text}")
        self.background_jobs.report.finish()
