"""A run's life: ask, dispatch, journal, tell. Owns the pure parts; knows no transport.

Everything that happens is durable before anybody is told that it counts: `commit` comes before the verdicts. The jobs
of a generation may leave before it: a coordinator that dies in between asks for the same population again.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from dreamfleet.common.protocol.messages import Result
from dreamfleet.common.runs.records import RunSettings, StoredConfirmation, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_folder import ENDING
from dreamfleet.common.runs.scoring_params import ScheduleState, ScoringParams
from dreamfleet.common.runs.stages import longest_horizon
from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.jobs.generation import CandidateScores, Generation
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.run.background_jobs import BackgroundJobs
from dreamfleet.coordinator.run.generations import Generations
from dreamfleet.coordinator.run.limits import stop_reason
from dreamfleet.coordinator.run.worker_protocol import WorkerProtocol
from dreamfleet.coordinator.settings.config import LimitsConfig
from dreamfleet.coordinator.storage.journal import Journal


class Run:
    """One incarnation of a run, new or continued."""

    def __init__(
        self,
        journal: Journal,
        settings: RunSettings,
        limits: LimitsConfig,
        fleet: Fleet,
        now: float,
        *,
        strict: bool = False,
    ) -> None:
        self.settings = settings
        self.limits = limits
        self.fleet = fleet
        self.ended: str | None = None
        self.paused: str | None = None
        self.uid = journal.fact("uid") or ""
        self.created = journal.fact("created") or ""  # ISO 8601, UTC
        self.incarnation = journal.begin_incarnation()
        self._journal = journal
        self._unpublished: list[StoredGeneration] = []
        if dropped := journal.drop_excessive(longest_horizon(settings)):
            fleet.notes.append(f"{dropped} results of an older version are too large to count: asked for again")
        self._ending = self._stored_end_reason()  # the limit that is reached: only what is in the slack is waited for
        closed, evaluations = journal.read_closed()
        self.history = History(closed)
        self._agenda = ScheduleState(settings)
        self.background_jobs = BackgroundJobs(journal, settings, self.uid, self.history, evaluations, self._agenda)
        self.worker_protocol = WorkerProtocol(
            journal,
            self.incarnation,
            fleet,
            self.background_jobs,
            self._record_score,
            horizon=settings.task.horizon,
            strict=strict,
        )
        evaluated = self.background_jobs.evaluations.finished
        self._generations = Generations(journal, settings, self._agenda, self.history, evaluated)
        self.opened_at = now
        self.generation = self._generations.begin()
        if self.incarnation > 1:  # the last life may have given what follows too, and died before it was written
            fleet.jobs.previous_epoch_until = self.generation.number + 1
        self._begin(now)

    @property
    def sigma(self) -> float:
        """The strategy's overall step size."""
        return self._generations.sigma

    @property
    def axis_ratio(self) -> float | None:
        """The longest axis of the strategy's distribution by the shortest; `None` where it does not say."""
        return self._generations.axis_ratio

    @property
    def scoring_params(self) -> ScoringParams:
        """Those of the open generation."""
        return self._generations.scoring_params

    @property
    def last(self) -> CandidateScores | None:
        """How the candidates of the generation that was closed last did."""
        return self._generations.last

    @property
    def best(self) -> StoredEvaluation | None:
        """The best evaluated mean."""
        return self.background_jobs.evaluations.best

    @property
    def confirmed(self) -> StoredConfirmation | None:
        """The confirmed score of what is reported; `None` where what is reported is not confirmed."""
        return self.background_jobs.confirmed

    @property
    def ending(self) -> bool:
        """Whether a limit is reached: evaluations and the confirmation are all that is waited for."""
        return self._ending is not None

    @property
    def controller_path(self) -> Path | None:
        """Where the reported controller lies; `None` while there is none: no generation was ever closed."""
        return self.background_jobs.report.path

    @property
    def state(self) -> str:
        """In a word, as the status tells it."""
        if self.ended is not None:
            return "ended"
        if self.paused is not None:
            return "paused"
        if not any(member.takes_jobs for member in self.worker_protocol.members):
            return "waiting for workers"
        return "evaluating" if self.fleet.drain_background else "running"

    def advance(self, now: float) -> bool:
        """Close what is complete and open what follows; whether a generation was opened."""
        closed = len(self.history)
        while self.ended is None and self.paused is None and self.generation.complete and not self._is_waiting:
            self._close(now)
        failure = self.fleet.jobs.find_pausing_failure()
        if failure is not None and self.paused is None:
            self.pause(f"{failure}; `dreamfleet resume` tries it again")
        self.fleet.drain_background = self._is_waiting
        self._finish()
        return len(self.history) > closed

    def commit(self) -> None:
        """Make everything so far durable; then the reported controller may be written."""
        self._journal.commit()
        self.background_jobs.report.save()

    def leave(self) -> None:
        """Make everything durable before the coordinator goes."""
        self._journal.commit()
        self.background_jobs.report.save(at_once=True)

    def prepare(self) -> None:
        """Work ahead while workers are busy."""
        self._generations.prepare()

    def pause(self, why: str) -> None:
        """Dispatch nothing more until the run is resumed."""
        self.paused = why
        self.fleet.paused = True
        self.fleet.notes.append(f"paused: {why}")

    def resume(self) -> None:
        """Go on; what failed is tried again anywhere."""
        if self.paused is not None:
            self.fleet.notes.append("resumed")
        self.paused = None
        self.fleet.paused = False
        self.fleet.jobs.clear_failures()

    def take_closed(self) -> list[StoredGeneration]:
        """Generations closed since the last call."""
        closed, self._unpublished = self._unpublished, []
        return closed

    @property
    def _is_waiting(self) -> bool:
        """Whether the run is ending, or the next generation's terms hang on an evaluation in progress."""
        deciding = self._agenda.required_evaluation(self.generation.number + 1)
        return self._ending is not None or (
            self.background_jobs.evaluations.is_open(deciding) and self.generation.complete
        )

    def _begin(self, now: float) -> None:
        generation = self.generation
        if len(self._agenda.stages) > 1:
            self.fleet.notes.append(f"generation {generation.number} is in {self._stage_told}")
        self._prepare_fleet(generation)
        work = self.background_jobs.begin(self._generations.mean, now)
        if self._ending is None and not generation.done and (reason := self._stop_reason(generation)):
            self._begin_ending(reason)
        if self._ending is None:
            self._journal.drop_fact("ended")
            self.fleet.jobs.offer([*work, *generation.missing])
        else:
            self.fleet.jobs.offer(work)
            self._finish()
            if self.ended is not None:
                self.commit()

    def _close(self, now: float) -> None:
        closed = self._generations.close(self.generation, now - self.opened_at)
        self._unpublished.append(closed)
        mean = self._generations.mean
        # Opened also when the run ends here: a later life with wider limits then goes on from it.
        generation = self._generations.open(closed.number + 1)
        reason = self._stop_reason(generation)
        self.fleet.jobs.offer(self.background_jobs.schedule(closed.number, mean, now, last=reason is not None))
        self._note_stage_changes(generation)
        self.generation, self.opened_at = generation, now
        self._prepare_fleet(generation)
        if reason:
            self.fleet.cancel_kind("score")
            self._begin_ending(reason)
        else:
            self.fleet.jobs.offer(generation.missing)

    def _prepare_fleet(self, generation: Generation) -> None:
        self.fleet.jobs.begin_generation(generation.number)
        self.fleet.single_job = self.scoring_params.stage.driven == 1

    def _note_stage_changes(self, generation: Generation) -> None:
        """Say for the log under which other terms a generation opens, and why."""
        begun, number = self.scoring_params.begun, generation.number
        if begun.since == number:
            self.fleet.notes.append(f"{self._stage_told} begins with generation {number} after {begun.why}")

    @property
    def _stage_told(self) -> str:
        stage = self.scoring_params.stage
        return f"stage {stage.number} of {len(self._agenda.stages)} ({stage.description})"

    def _record_score(self, result: Result) -> None:
        assert result.fitness is not None
        if self.generation.record(result.digest, result.fitness, result.steps):
            self.fleet.jobs.offer(self.generation.missing)

    def _stop_reason(self, generation: Generation) -> str | None:
        """Why the run ends before `generation` is scored; `None` if it goes on."""
        if generation.is_one_point:
            return f"converged: generation {generation.number} is one point; fork the run with a larger --sigma0"
        return stop_reason(self.limits, self.history, self.background_jobs.evaluations)

    def _finish(self) -> None:
        """Where a limit is reached and its last evaluations are in: confirm what is reported, then end."""
        if self._ending is None or self.background_jobs.in_progress or self.ended is not None:
            return
        if work := self.background_jobs.confirm():
            self.fleet.notes.append(self.background_jobs.round_description)
            self.fleet.jobs.offer(work)
        else:
            self._end()

    def _begin_ending(self, reason: str) -> None:
        """A limit is reached. It is written with what reached it: by the last evaluations it may look otherwise."""
        self._ending = reason
        self._journal.set_fact(ENDING, json.dumps([reason, asdict(self.limits)]))

    def _stored_end_reason(self) -> str | None:
        """The limit that an earlier life reached; `None` where this one has other limits."""
        reason, limits = json.loads(self._journal.fact(ENDING) or "[null, null]")
        return reason if limits == asdict(self.limits) else None

    def _end(self) -> None:
        self.ended = self._ending or "stopped"
        self._journal.end(self.ended)
        self.background_jobs.report.finish()
