"""A run's life: ask, dispatch, journal, tell. Owns the pure parts; knows no transport.

Everything that happens is durable before anybody is told that it counts: `commit` comes before the verdicts. The jobs
of a generation may leave before it: a coordinator that dies in between asks for the same population again.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from dreamfleet.common.controller import Controller
from dreamfleet.common.errors import JournalError
from dreamfleet.common.files import write_aside
from dreamfleet.common.heat import deciding_check, raised_temperature
from dreamfleet.common.messages import HelloRequest, Job, Result, ResultBatch, UploadPart
from dreamfleet.common.runs import CONTROLLER, RunSettings, StoredEvaluation, StoredGeneration, rollout_path
from dreamfleet.common.seeds import training_seed
from dreamfleet.coordinator.collection import Collection
from dreamfleet.coordinator.config import LimitsConfig
from dreamfleet.coordinator.evaluation import Evaluation, parted
from dreamfleet.coordinator.evolution import Evolution, EvolutionConfig
from dreamfleet.coordinator.fleet import Fleet
from dreamfleet.coordinator.generation import Generation
from dreamfleet.coordinator.jobs import travelling
from dreamfleet.coordinator.journal import Journal
from dreamfleet.coordinator.start import Start
from dreamfleet.coordinator.uploads import Uploads


@dataclass
class OpenEvaluation:
    """An evaluation in progress: scores by digest."""

    evaluation: Evaluation
    digests: list[bytes]
    scores: dict[bytes, float]


class Run:
    """One incarnation of a run, new or continued."""

    def __init__(
        self,
        journal: Journal,
        settings: RunSettings,
        limits: LimitsConfig,
        fleet: Fleet,
        now: float,
        start: Start | None = None,
    ) -> None:
        self.settings = settings
        self.limits = limits
        self.fleet = fleet
        self.history: list[StoredGeneration] = []
        self.evaluations: list[StoredEvaluation] = []
        self.ended: str | None = None
        self.paused: str | None = None
        self._untold: list[StoredGeneration] = []
        self._journal = journal
        self._evaluating: dict[int, OpenEvaluation] = {}
        self.uploads = Uploads()
        self._collecting: set[bytes] = set()  # digests of the drives that are still to come
        self._collections = 0  # drives that were ever scheduled
        self._ending = False  # a limit is reached: only evaluations and collected drives are waited for
        self.uid = journal.fact("uid") or ""
        self.fingerprint = journal.fact("fingerprint")
        self.incarnation = journal.begin_incarnation()
        self._evolution = Evolution(EvolutionConfig.of(settings), start.mean if start else None)
        if start:
            journal.set_fact("start", start.source)
        self.opened = now
        self.generation = self._begin(now)

    @property
    def sigma(self) -> float:
        """The strategy's overall step size."""
        return self._evolution.sigma

    @property
    def temperature(self) -> float | None:
        """At which the open generation dreams; `None` where a task has none."""
        return self.settings.task.at(self.generation.temperature).temperature

    def refusal(self, request: HelloRequest, mixed: bool) -> tuple[str, str] | None:
        """Why a worker cannot join and what to do about it; `None` if it may."""
        task = self.settings.task.task
        if task not in request.tasks:
            known = ", ".join(request.tasks) or "none"
            return f"this run scores in {task!r}, which the worker does not know (it knows: {known})", (
                "install the package that registers this task on the worker's host"
            )
        if mixed or self.fingerprint in (None, request.fingerprint):
            return None
        return f"fingerprints differ: the run has [{self.fingerprint}], the worker [{request.fingerprint}]", (
            "install the same package versions on a host of the same CPU features, or start the coordinator with "
            "--mixed"
        )

    def admit(self, request: HelloRequest, now: float) -> None:
        """Welcome a worker; the first one's fingerprint becomes the run's."""
        if self.fingerprint is None:
            self.fingerprint = request.fingerprint
            self._journal.set_fact("fingerprint", request.fingerprint)
        self.fleet.welcome(request.worker, request.slots, request.fingerprint, now)

    def results(self, worker: str, batch: ResultBatch, now: float) -> None:
        """Judge a worker's results; the first wanted ones are written and counted."""
        for each in batch.results:
            result = self._with_upload(worker, each)
            if result is None:
                self.fleet.put_off(worker, each.digest, now)
                continue
            _, work = self.fleet.result(worker, result, now)
            if work is not None:
                self._journal.add_result(work.job, result, worker, batch.fingerprint, self.incarnation)
                if work.job.kind == "score":
                    self._score(result)
                elif work.job.kind == "evaluate":
                    self._evaluated(work.job.generation, result)
                else:
                    self._collecting.discard(result.digest)
            self.uploads.forget(result.digest)

    def upload(self, worker: str, part: UploadPart, now: float) -> None:
        """Take in part of a drive, from a worker that was given the job and while it is wanted."""
        work = self.fleet.wants(part.digest)
        if work is None or work.job.kind != "collect" or not self.fleet.holds(worker, part.digest):
            self.uploads.dropped["unwanted upload"] += 1
            return
        self.uploads.add(worker, part, now)

    def advance(self, now: float) -> bool:
        """Close what is complete and open what follows; whether a generation was opened."""
        closed = len(self.history)
        while self.ended is None and self.paused is None and self.generation.complete and not self._waiting:
            self._close(now)
        poison = self.fleet.poison()
        if poison is not None and self.paused is None:
            work, errors = poison
            reasons = "; ".join(f"{worker}: {error}" for worker, error in errors.items())
            self.pause(f"candidate {work.job.generation}/{work.job.candidate} failed on two workers ({reasons})")
        self.uploads.tick(now)
        self.fleet.hurry = self._waiting
        if self._ending and not self._in_slack and self.ended is None:
            self._end(self._stop_reason() or "stopped")
        return len(self.history) > closed

    def commit(self) -> None:
        """Make everything so far durable."""
        self._journal.commit()

    def prepare(self) -> None:
        """Work ahead while workers are busy."""
        self._evolution.prepare()

    def pause(self, why: str) -> None:
        """Dispatch nothing more until the run is resumed."""
        self.paused = why
        self.fleet.paused = True

    def resume(self) -> None:
        """Go on; what failed is tried again anywhere."""
        self.paused = None
        self.fleet.paused = False
        self.fleet.pardon()

    def take_closed(self) -> list[StoredGeneration]:
        """Generations closed since the last call."""
        closed, self._untold = self._untold, []
        return closed

    @property
    def evaluation_progress(self) -> tuple[int, int]:
        """Episodes of open evaluations: done, wanted."""
        open_ones = self._evaluating.values()
        return sum(len(each.scores) for each in open_ones), sum(len(each.digests) for each in open_ones)

    @property
    def collection_progress(self) -> tuple[int, int]:
        """Drives of the mean, of the whole run: kept, wanted."""
        return self._collections - len(self._collecting), self._collections

    @property
    def best(self) -> StoredEvaluation | None:
        """The best evaluated mean."""
        return max(self.evaluations, key=lambda each: each.mean, default=None)

    @property
    def steps(self) -> int:
        """Environment steps of all closed generations."""
        return sum(each.steps for each in self.history)

    def controller(self) -> Controller:
        """What the run reports: its best evaluated mean, else the last mean; never the luckiest sample."""
        best = self._journal.best_evaluation()
        generation, score, vector = best or (len(self.history) - 1, None, travelling(self._evolution.mean))
        provenance = {"run_uid": self.uid, "generation": generation, "validation_mean": score}
        return Controller(
            self.settings.controller,
            np.frombuffer(vector, dtype="<f4").astype(np.float32),
            self.settings.task.task,
            self.settings.task.bundle,
            {**provenance, "settings": asdict(self.settings), "steps": self.steps},
        )

    def _begin(self, now: float) -> Generation:
        """The first generation of a new run, or the one that was open when the last incarnation ended."""
        last = self._journal.last_generation()
        if last is None:
            return self._open(0, now)
        self._evolution.restore(last.state)
        vectors = tuple(travelling(x) for x in self._evolution.ask())
        if vectors != last.vectors:
            raise JournalError(
                f"generation {last.number} cannot be continued: the strategy asks for another population than the "
                "journal holds; use the host and package versions that wrote it"
            )
        self.history, self.evaluations = self._journal.closed()
        generation = self._generation(last.number, last.vectors, last.seeds)
        for digest, (fitness, steps) in self._journal.results_of("score", last.number).items():
            generation.record(digest, fitness, steps)
        for evaluation in self._journal.pending_evaluations():
            self._reopen(evaluation)
        for collection in self._journal.collections():
            self._collect(collection)
        if (reason := self._stop_reason()) is not None and not generation.done:
            self._ending = self._in_slack
            self.ended = None if self._in_slack else reason
        else:
            self._journal.drop_fact("ended")
            self.fleet.offer(generation.missing)
        return generation

    def _open(self, number: int, now: float) -> Generation:
        state, sigma = self._evolution.state(), self._evolution.sigma
        vectors = [travelling(x) for x in self._evolution.ask()]
        seeds = [training_seed(self.settings.seed, number, episode) for episode in range(self.settings.episodes)]
        self._journal.open_generation(number, state, sigma, seeds, vectors)
        generation = self._generation(number, vectors, seeds)
        if number and generation.temperature != self.generation.temperature:
            self.fleet.notes.append(
                f"generation {number} dreams at temperature {generation.temperature:g}: the evaluated mean fell"
            )
        self.opened = now
        self.fleet.begin(number)
        self.fleet.offer(generation.missing)
        return generation

    def _generation(self, number: int, vectors: Sequence[bytes], seeds: Sequence[int]) -> Generation:
        temperature = raised_temperature(number, self.settings, self.evaluations)
        return Generation(
            number, self.settings.task, vectors, seeds, racing=self.settings.racing, temperature=temperature
        )

    def _close(self, now: float) -> None:
        fitness = self.generation.fitness()
        closed = StoredGeneration(
            number=self.generation.number,
            mean=float(fitness.mean()),
            std=float(fitness.std()),
            best=float(fitness.max()),
            worst=float(fitness.min()),
            sigma=self._evolution.sigma,
            steps=self.generation.steps,
            seconds=now - self.opened,
        )
        self._evolution.tell(fitness)
        self._journal.close_generation(closed, fitness)
        self.history.append(closed)
        self._untold.append(closed)
        reason = self._stop_reason()
        if _is_due(self.settings.evaluate_every, closed.number, last=bool(reason)):
            self._evaluate(closed.number)
        if _is_due(self.settings.collect_every, closed.number, last=bool(reason)):
            mean = travelling(self._evolution.mean)
            collection = Collection(closed.number, mean, self.settings.collect_episodes)
            self._journal.schedule_collection(collection)
            self._collect(collection)
        # Opened also when the run ends here: a later life with wider limits then goes on from it.
        self.generation = self._open(closed.number + 1, now)
        if reason:
            self.fleet.withdraw("score")
            self._ending = True

    def _evaluate(self, generation: int) -> None:
        evaluation = Evaluation(generation, travelling(self._evolution.mean), self.settings.evaluation_episodes)
        self._journal.schedule_evaluation(evaluation)
        self._reopen(evaluation)

    def _reopen(self, evaluation: Evaluation) -> None:
        work = evaluation.work(self.settings.task)
        known = self._journal.results_of("evaluate", evaluation.generation)
        scores = {digest: fitness for digest, (fitness, _) in known.items()}
        self._evaluating[evaluation.generation] = OpenEvaluation(evaluation, [each.job.digest for each in work], scores)
        self.fleet.offer([each for each in work if each.job.digest not in scores])
        self._finish_evaluation(evaluation.generation)

    def _collect(self, collection: Collection) -> None:
        known = self._journal.results_of("collect", collection.generation)
        work = collection.work(self.settings.task, self.settings.seed)
        missing = [each for each in work if each.job.digest not in known]
        self._collections += len(work)
        self._collecting.update(each.job.digest for each in missing)
        self.fleet.offer(missing)

    def _with_upload(self, worker: str, result: Result) -> Result | None:
        """The result as it may be judged, its drive on disk if it has one; `None` while the drive is on its way."""
        work = self.fleet.wants(result.digest)
        if work is None or work.job.kind != "collect" or result.fitness is None:
            return result
        if result.upload is None:
            return replace(result, fitness=None, error="the drive was not kept: update dreamfleet on this host")
        data = self.uploads.take(worker, result.digest, result.upload)
        if data is None:
            return None
        self._keep(work.job, data)
        return result

    def _keep(self, job: Job, data: bytes) -> None:
        path = rollout_path(self._journal.path.parent, job.generation, job.episode)
        try:
            with write_aside(path) as file:
                file.write(data)
        except OSError as error:
            raise JournalError(f"cannot write {path}: {error.strerror}; make room and continue the run") from error

    @property
    def _waiting(self) -> bool:
        """Whether the run is ending, or the next generation's temperature hangs on an evaluation in progress."""
        check = deciding_check(self.settings, self.generation.number + 1)
        return self._ending or (check in self._evaluating and self.generation.complete)

    @property
    def _in_slack(self) -> bool:
        return bool(self._evaluating or self._collecting)

    def _score(self, result: Result) -> None:
        assert result.fitness is not None
        if self.generation.record(result.digest, result.fitness, result.steps):
            self.fleet.offer(self.generation.missing)

    def _evaluated(self, generation: int, result: Result) -> None:
        assert result.fitness is not None
        self._evaluating[generation].scores[result.digest] = result.fitness
        self._finish_evaluation(generation)

    def _finish_evaluation(self, generation: int) -> None:
        each = self._evaluating[generation]
        if len(each.scores) < len(each.digests):
            return
        scores = np.array([each.scores[digest] for digest in each.digests])
        finished = StoredEvaluation(generation, len(scores), float(scores.mean()), float(scores.std()))
        self._journal.finish_evaluation(generation, finished.mean, finished.std)
        insort(self.evaluations, finished, key=lambda other: other.generation)
        del self._evaluating[generation]

    def _stop_reason(self) -> str | None:
        limits = self.limits
        if limits.generations and len(self.history) >= limits.generations:
            return f"{len(self.history)} generations"
        if limits.steps and self.steps >= limits.steps:
            return f"{self.steps} environment steps"
        if limits.minutes and sum(each.seconds for each in self.history) >= 60 * limits.minutes:
            return f"{limits.minutes:g} minutes"
        best = self.best
        if limits.target is not None and best is not None and best.mean >= limits.target:
            return f"the mean of generation {best.generation} reached {best.mean:.1f}"
        if best is not None and limits.parted and parted(self.evaluations, limits.parted):
            return f"the evaluated mean fell behind generation {best.generation}'s"
        return None

    def _end(self, reason: str) -> None:
        self.ended = reason
        self._journal.set_fact("ended", reason)
        self.controller().save(self._journal.path.parent / CONTROLLER)


def _is_due(every: int, generation: int, *, last: bool) -> bool:
    return every > 0 and (generation % every == every - 1 or last)
