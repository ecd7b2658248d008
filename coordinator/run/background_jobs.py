"""Jobs that a run wants beside scoring, for idle slots: evaluate its mean, collect rollouts of it, confirm the end."""

from collections.abc import Iterable, Sequence
from functools import partial
from math import isnan, nan

from dreamfleet.common.protocol.messages import Job
from dreamfleet.common.runs.records import RunSettings, StoredConfirmation, StoredEvaluation
from dreamfleet.common.runs.run_folder import CONFIRMED
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.common.runs.stages import StageTracker
from dreamfleet.coordinator.jobs.confirmation import FINALISTS, Confirmation, total_episodes
from dreamfleet.coordinator.jobs.evaluation import Evaluation, Evaluations
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.jobs.rollout_collection import RolloutCollection, RolloutCollections
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob
from dreamfleet.coordinator.run.report import ControllerWriter
from dreamfleet.coordinator.run.verification import Verification
from dreamfleet.coordinator.settings.run_provenance import build_provenance
from dreamfleet.coordinator.storage.journal import Journal


class BackgroundJobs:
    """Evaluations, confirmation and kept rollouts of a run, and the report that follows from them."""

    def __init__(
        self, journal: Journal, settings: RunSettings, run_uid: str, history: History,
        evaluations: Iterable[StoredEvaluation], agenda: StageTracker,
        verification: Verification,
    ) -> None:  # fmt: skip
        """`agenda` knows the stage of each generation when it closes.

        An evaluation is not finished before its results are checked, as far as `verification` draws them.
        """
        folder = journal.path.parent
        self.evaluations = Evaluations(evaluations)
        self.rollout_collections = RolloutCollections(folder)
        self.report = ControllerWriter(
            folder / CONTROLLER, run_uid, settings,
            lambda: build_provenance(journal, settings, len(history), history.failed, verification.summary),
        )  # fmt: skip
        self._journal = journal
        self._settings = settings
        self._history = history
        self._agenda = agenda
        self._verification = verification
        self._confirmation: Confirmation | None = None  # while the run is ending
        text = journal.fact(CONFIRMED)
        self._confirmed = None if text is None else StoredConfirmation.from_json(text)

    @property
    def in_progress(self) -> bool:
        """Whether any evaluation, collection or round of the confirmation is unfinished."""
        confirming = self._confirmation is not None and self._confirmation.in_progress
        return bool(self.evaluations.open_count or self.rollout_collections.missing_count or confirming)

    def retry_failed(self) -> list[ScoringJob]:
        """Forget the failed episodes of what is open, in the journal too; their jobs."""
        work = self.evaluations.retry_failed(self._settings.task)
        if self._confirmation is not None:
            work += self._confirmation.retry_failed()
        self._journal.drop_failures_of([each.digest for each in work])
        return work

    @property
    def confirmed(self) -> StoredConfirmation | None:
        """The confirmed score of the reported mean; `None` if that is not confirmed."""
        found = self._confirmed
        return found if found is not None and found.covers(self.evaluations.best) else None

    @property
    def confirmation_failed(self) -> bool:
        """Whether every episode of the last round failed, so that there is no confirmed score."""
        return self._confirmation is not None and self._confirmation.failed

    @property
    def confirming(self) -> tuple[int, int]:
        """Episodes of the confirmation's open round: (done, wanted)."""
        return (0, 0) if self._confirmation is None else self._confirmation.progress

    def episodes_until_end(self, *, ending: bool) -> int:
        """Estimate the episodes that remain once a limit is reached; `ending`: it is reached already.

        They are those of evaluations in progress, of the last evaluation, and of the confirmation.
        """
        settings, (done, wanted) = self._settings, self.evaluations.progress
        if self._confirmation is not None:
            return wanted - done + self._confirmation.remaining_episodes
        if ending and self._confirmed is not None and self._confirmed.closed == len(self._history):
            return wanted - done
        last = not ending and settings.evaluate_every > 0
        finalists = min(len(self.evaluations) + self.evaluations.open_count + last, FINALISTS)
        confirming = total_episodes(finalists, settings.confirm_episodes)
        return wanted - done + last * settings.evaluation_episodes + confirming

    @property
    def round_description(self) -> str:
        """The confirmation's open round, in words."""
        return "" if self._confirmation is None else self._confirmation.round_description

    def begin(self, mean: bytes, now: float) -> list[ScoringJob]:
        """Restore the report of the last incarnation; the jobs that are still missing."""
        if (last := self._history.last) is not None:
            self.report.generation_closed(last.number, mean, self._history.steps, now)
        else:  # else a file of a copy, or of before a recall, would be the run's
            self.report.withdraw()
        if (judged := self.confirmed or self.evaluations.best) is not None:
            self.report.set_judged(judged, self._journal.evaluated_vector(judged.generation), self._history.steps)
        self.rollout_collections.remove(self._journal.recalls.rollouts())  # not before the recall was durable
        evaluations = [
            each for evaluation in self._journal.pending_evaluations() for each in self._evaluate(evaluation)
        ]
        return evaluations + [each for item in self._journal.scheduled_collections() for each in self._collect(item)]

    def schedule(self, generation: int, mean: bytes, now: float, *, last: bool) -> list[ScoringJob]:
        """The jobs that are due after a closed generation; after the `last` one all are."""
        settings, work = self._settings, []
        self.report.generation_closed(generation, mean, self._history.steps, now)
        if _is_due(settings.evaluate_every, generation, last=last):
            evaluation = Evaluation(generation, mean, settings.evaluation_episodes)
            self._journal.schedule_evaluation(evaluation)
            work += self._evaluate(evaluation)
        if _is_due(settings.collect_every, generation, last=last):
            collection = RolloutCollection(generation, mean, settings.collect_episodes)
            self._journal.schedule_collection(collection)
            work += self._collect(collection)
        return work

    def count(self, job: Job, fitness: float) -> None:
        """Count an accepted, journalled result; `fitness` is NaN for an episode that failed for good."""
        if job.kind == "collect":
            self.rollout_collections.finish(job.digest)
            return
        for generation in self.evaluations.record(job.digest, fitness):
            self._finish(generation)
        if self._confirmation is not None:
            self._confirmation.record(job.digest, fitness)

    def confirm(self) -> list[ScoringJob]:  # docs/explanation/dreams.md
        """The next jobs that confirm the reported mean; call it when a limit is reached and nothing is in progress.

        Empty once the mean is confirmed, or if nothing was evaluated; also while only checks are missing.
        """
        closed = len(self._history)
        if self._confirmation is None:
            if self._confirmed is not None and self._confirmed.closed == closed:
                return []
            episodes, finalists = self._settings.confirm_episodes, self._journal.finalists(FINALISTS)
            if not (episodes and finalists):
                return []
            self._confirmation = Confirmation(self._settings.task, episodes, finalists, closed)
        work = self._confirmation.advance(partial(self._journal.fitness_of, "evaluate"), self._check_again)
        if self._confirmation.failed:
            return []
        if (outcome := self._confirmation.outcome) is not None:
            self._journal.set_fact(CONFIRMED, outcome.to_json())
            self._confirmation, self._confirmed = None, outcome
            self.report.set_judged(outcome, self._journal.evaluated_vector(outcome.generation), self._history.steps)
        return work

    def _check_again(self, work: Sequence[ScoringJob]) -> bool:
        """Check what an earlier incarnation accepted of these jobs unchecked; whether any waits for its check."""
        self._verification.restore(work)
        return self._verification.is_checking(each.digest for each in work)

    def have_fallen_behind(self, count: int) -> bool:
        """Whether each of the last `count` evaluated means is clearly below the best one before them."""
        return self.evaluations.have_fallen_behind(count, self._evaluated_scores)

    def _evaluated_scores(self, generation: int) -> dict[int, float]:
        """An evaluated mean's scores by seed, from the journal (R28), whichever evaluation of that mean had them."""
        vector, settings = self._journal.evaluated_vector(generation), self._settings
        work = Evaluation(generation, vector, settings.evaluation_episodes).work(settings.task)
        known = self._journal.fitness_of("evaluate", work)
        scores = {each.job.seeds[0]: known.get(each.digest, nan) for each in work}
        return {seed: score for seed, score in scores.items() if not isnan(score)}

    def _evaluate(self, evaluation: Evaluation) -> list[ScoringJob]:
        wanted = evaluation.work(self._settings.task)
        work = self.evaluations.open(evaluation, self._settings.task, self._journal.fitness_of("evaluate", wanted))
        self._verification.restore(wanted)
        self._finish(evaluation.generation)
        return work

    def settle(self) -> None:
        """Finish the evaluations that waited for a check alone."""
        for generation in self.evaluations.scored:
            self._finish(generation)

    def _finish(self, generation: int) -> None:
        if self._verification.is_checking(self.evaluations.digests(generation)):
            return
        found = self.evaluations.finish(generation)
        if found is None:
            return
        self._journal.finish_evaluation(generation, found.found, found.failed)
        if found.found is not None and self.evaluations.best is found.found:
            self.report.set_judged(found.found, found.vector, self._history.steps)

    def _collect(self, collection: RolloutCollection) -> list[ScoringJob]:
        known = self._journal.results.of("collect", collection.generation)
        spec, settings = self._agenda.stage_of(collection.generation).stage.settings.task, self._settings
        return self.rollout_collections.open(collection.work(spec, settings.seed, settings.task), known)


def _is_due(every: int, generation: int, *, last: bool) -> bool:
    return every > 0 and (generation % every == every - 1 or last)
