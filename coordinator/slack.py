"""What a run wants beside scoring: its mean evaluated, rollouts of it kept. It fills what scoring leaves idle."""

from __future__ import annotations

from collections.abc import Iterable

from dreamfleet.common.messages import Result
from dreamfleet.common.runs import CONTROLLER, RunSettings, StoredEvaluation
from dreamfleet.coordinator.collection import Collection, Collections
from dreamfleet.coordinator.evaluation import Evaluation, Evaluations
from dreamfleet.coordinator.history import History
from dreamfleet.coordinator.jobs import Work
from dreamfleet.coordinator.journal import Journal
from dreamfleet.coordinator.report import Report


class Slack:
    """Evaluations and kept rollouts of one run, and the report that follows from the evaluations."""

    def __init__(
        self, journal: Journal, settings: RunSettings, run_uid: str, history: History,
        evaluations: Iterable[StoredEvaluation],
    ) -> None:  # fmt: skip
        folder = journal.path.parent
        self.evaluations = Evaluations(evaluations)
        self.collections = Collections(folder)
        self.report = Report(folder / CONTROLLER, run_uid, settings)
        self._journal = journal
        self._settings = settings
        self._history = history

    @property
    def in_progress(self) -> bool:
        """Whether anything is still to come."""
        return bool(self.evaluations.in_progress or self.collections.in_progress)

    def begin(self, mean: bytes, now: float) -> list[Work]:
        """Continue where the last incarnation ended: what is reported, and the missing jobs."""
        if (last := self._history.last) is not None:
            self.report.closed(last.number, mean, self._history.steps, now)
        if (best := self._journal.best_evaluation()) is not None:
            generation, score, vector = best
            self.report.evaluated(generation, vector, score, self._history.steps)
        evaluations = [
            each for evaluation in self._journal.pending_evaluations() for each in self._evaluate(evaluation)
        ]
        return evaluations + [each for item in self._journal.collections() for each in self._collect(item)]

    def schedule(self, generation: int, mean: bytes, now: float, *, last: bool) -> list[Work]:
        """The jobs that are due after a generation was closed; after the `last` one all are."""
        settings, work = self._settings, []
        self.report.closed(generation, mean, self._history.steps, now)
        if _is_due(settings.evaluate_every, generation, last=last):
            evaluation = Evaluation(generation, mean, settings.evaluation_episodes)
            self._journal.schedule_evaluation(evaluation)
            work += self._evaluate(evaluation)
        if _is_due(settings.collect_every, generation, last=last):
            collection = Collection(generation, mean, settings.collect_episodes)
            self._journal.schedule_collection(collection)
            work += self._collect(collection)
        return work

    def count(self, work: Work, result: Result) -> None:
        """Take an accepted result, which is in the journal."""
        if work.job.kind == "collect":
            self.collections.finish(result.digest)
            return
        assert result.fitness is not None
        for generation in self.evaluations.record(result.digest, result.fitness):
            self._finish(generation)

    def _evaluate(self, evaluation: Evaluation) -> list[Work]:
        wanted = [each.job.digest for each in evaluation.work(self._settings.task)]
        work = self.evaluations.open(evaluation, self._settings.task, self._journal.fitness_of(wanted))
        self._finish(evaluation.generation)
        return work

    def _finish(self, generation: int) -> None:
        found = self.evaluations.finish(generation)
        if found is None:
            return
        finished, vector = found
        self._journal.finish_evaluation(generation, finished.mean, finished.std)
        if self.evaluations.best is finished:
            self.report.evaluated(generation, vector, finished.mean, self._history.steps)

    def _collect(self, collection: Collection) -> list[Work]:
        known = self._journal.results_of("collect", collection.generation)
        return self.collections.open(collection.work(self._settings.task, self._settings.seed), known)


def _is_due(every: int, generation: int, *, last: bool) -> bool:
    return every > 0 and (generation % every == every - 1 or last)
