"""A run's life: ask, dispatch, journal, tell. Owns the pure parts; knows no transport.

Everything that happens is durable before anybody is told that it counts: `commit` comes before the verdicts. The jobs
of a generation may leave before it: a coordinator that dies in between asks for the same population again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from pathlib import Path

from dreamfleet.common.heat import deciding_check
from dreamfleet.common.messages import Beat, HelloRequest, Result, ResultBatch, UploadPart
from dreamfleet.common.runs import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.coordinator.admission import refusal
from dreamfleet.coordinator.config import LimitsConfig
from dreamfleet.coordinator.evolution import Evolution, EvolutionConfig
from dreamfleet.coordinator.failure import Failure
from dreamfleet.coordinator.fleet import Fleet, Send
from dreamfleet.coordinator.generation import Generation, Standing
from dreamfleet.coordinator.generations import Generations
from dreamfleet.coordinator.history import History
from dreamfleet.coordinator.jobs import Work
from dreamfleet.coordinator.journal import Journal
from dreamfleet.coordinator.limits import stop_reason
from dreamfleet.coordinator.member import Member
from dreamfleet.coordinator.slack import Slack
from dreamfleet.coordinator.start import Start
from dreamfleet.coordinator.uploads import Uploads

MOST_REFUSED = 8


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
        self.ended: str | None = None
        self.paused: str | None = None
        self.refused: dict[str, str] = {}  # workers that could not join, the latest last, and why
        self.uid = journal.fact("uid") or ""
        self.fingerprint = journal.fact("fingerprint")
        self.incarnation = journal.begin_incarnation()
        self._journal = journal
        self._untold: list[StoredGeneration] = []
        self._ending = False  # a limit is reached: only evaluations and collected drives are waited for
        closed, evaluations = journal.closed()
        self.history = History(closed)
        self.slack = Slack(journal, settings, self.uid, self.history, evaluations)
        self._evolution = Evolution(
            EvolutionConfig(
                settings.controller.size, settings.population, settings.sigma0, settings.covariance, settings.seed
            ),
            start.mean if start else None,
        )
        if start:
            journal.set_fact("start", start.source)
        checks = self.slack.evaluations.finished
        self._generations = Generations(journal, settings, self._evolution, self.history, checks)
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

    @property
    def last(self) -> Standing | None:
        """How the candidates of the generation that was closed last did."""
        return self._generations.last

    @property
    def best(self) -> StoredEvaluation | None:
        """The best evaluated mean."""
        return self.slack.evaluations.best

    @property
    def controller_path(self) -> Path | None:
        """Where the reported controller lies; `None` while there is none: no generation was ever closed."""
        return self.slack.report.path

    @property
    def state(self) -> str:
        """In a word, as the status tells it."""
        if self.ended is not None:
            return "ended"
        if self.paused is not None:
            return "paused"
        if not any(member.present and member.capacity for member in self.members):
            return "waiting for workers"
        return "evaluating" if self.fleet.hurry else "running"

    @property
    def members(self) -> Collection[Member]:
        """The workers that are known."""
        return self.fleet.members.values()

    @property
    def counts(self) -> Counter[str]:
        """What became of jobs, results and batches."""
        return self.fleet.counts

    @property
    def failures(self) -> list[Failure]:
        """Wanted jobs that failed somewhere."""
        return self.fleet.failures

    @property
    def dropped(self) -> Counter[str]:
        """Parts of uploads that were dropped, by reason."""
        return self._uploads.dropped

    @property
    def _uploads(self) -> Uploads:
        return self.slack.collections.uploads

    def refusal(self, request: HelloRequest, mixed: bool) -> tuple[str, str] | None:
        """Why a worker cannot join and what to do about it; `None` if it may."""
        found = refusal(request, self.settings.task.task, None if mixed else self.fingerprint, self.settings.packages)
        if found is not None and request.packages == self.settings.packages:
            self._remember_refusal(request.worker, found[0])
        return found

    def _remember_refusal(self, worker: str, why: str) -> None:
        name = worker.partition("/")[0]  # a worker that is started again and again has one name and many lives
        if self.refused.get(name) != why:
            self.fleet.notes.append(f"refused worker {worker}: {why}")
        self.refused.pop(name, None)
        self.refused[name] = why
        while len(self.refused) > MOST_REFUSED:
            del self.refused[next(iter(self.refused))]

    def admit(self, request: HelloRequest, now: float) -> None:
        """Welcome a worker; the first one's fingerprint becomes the run's."""
        self.refused.pop(request.worker.partition("/")[0], None)
        if self.fingerprint is None:
            self.fingerprint = request.fingerprint
            self._journal.set_fact("fingerprint", request.fingerprint)
        self.fleet.welcome(request.worker, request.slots, request.fingerprint, now)

    def beat(self, worker: str, beat: Beat, now: float) -> None:
        """A worker says what it holds."""
        self.fleet.beat(worker, beat, now)

    def depart(self, worker: str, now: float) -> None:
        """A worker's token vanished."""
        self.fleet.depart(worker, now)

    def results(self, worker: str, batch: ResultBatch, now: float) -> None:
        """Judge a worker's results; the first wanted ones are written and counted."""
        for each in batch.results:
            result = self.slack.collections.receive(worker, each, self.fleet.wants(each.digest))
            if result is None:
                self.fleet.put_off(worker, each.digest, now)
                continue
            _, work = self.fleet.result(worker, result, now)
            if work is not None:
                self._journal.add_result(work.job, result, worker, batch.fingerprint, self.incarnation)
                self._count(work, result)
            self._uploads.forget(result.digest)

    def upload(self, worker: str, part: UploadPart, now: float) -> None:
        """Take in part of a drive, from a worker that was given the job and while it is wanted."""
        work = self.fleet.wants(part.digest)
        if work is None or work.job.kind != "collect" or not self.fleet.holds(worker, part.digest):
            self.dropped["unwanted upload"] += 1
            return
        self._uploads.add(worker, part, now)

    def tick(self, now: float) -> None:
        """Let time pass: departures, silences, uploads that stopped."""
        self.fleet.tick(now)
        self._uploads.tick(now)

    def advance(self, now: float) -> bool:
        """Close what is complete and open what follows; whether a generation was opened."""
        closed = len(self.history)
        while self.ended is None and self.paused is None and self.generation.complete and not self._waiting:
            self._close(now)
        failure = self.fleet.poison()
        if failure is not None and self.paused is None:
            self.pause(f"{failure}; `dreamfleet resume` tries it again")
        self.fleet.hurry = self._waiting
        if self._ending and not self.slack.in_progress and self.ended is None:
            self._end()
        return len(self.history) > closed

    @property
    def jobs(self) -> int:
        """Jobs that are wanted."""
        return self.fleet.open

    @property
    def leased(self) -> int:
        """Jobs in workers' hands, copies counted."""
        return self.fleet.leased

    def dispatch(self, now: float, *, durable: bool = True) -> list[Send]:
        """Batches to send now; verdicts stay until everything so far is `durable`."""
        return self.fleet.dispatch(now, durable=durable)

    def commit(self) -> None:
        """Make everything so far durable; then the reported controller may be written."""
        self._journal.commit()
        self.slack.report.save()

    def leave(self) -> None:
        """Make everything durable before the coordinator goes."""
        self._journal.commit()
        self.slack.report.save(at_once=True)

    def prepare(self) -> None:
        """Work ahead while workers are busy."""
        self._evolution.prepare()

    def pause(self, why: str) -> None:
        """Dispatch nothing more until the run is resumed."""
        self.paused = why
        self.fleet.paused = True
        self.fleet.notes.append(f"paused: {why}")

    def resume(self) -> None:
        """Go on; what failed is tried again anywhere."""
        self.paused = None
        self.fleet.paused = False
        self.fleet.pardon()

    def take_closed(self) -> list[StoredGeneration]:
        """Generations closed since the last call."""
        closed, self._untold = self._untold, []
        return closed

    def take_notes(self) -> list[str]:
        """What happened since the last call, for a log."""
        notes, self.fleet.notes = self.fleet.notes, []
        return notes

    @property
    def _waiting(self) -> bool:
        """Whether the run is ending, or the next generation's temperature hangs on an evaluation in progress."""
        check = deciding_check(self.settings, self.generation.number + 1)
        return self._ending or (self.slack.evaluations.awaits(check) and self.generation.complete)

    def _begin(self, now: float) -> Generation:
        generation = self._generations.begin()
        self.fleet.begin(generation.number)
        work = self.slack.begin(self._generations.mean, now)
        if self._stop_reason() is None or generation.done:
            self._journal.drop_fact("ended")
            self.fleet.offer([*work, *generation.missing])
        elif self.slack.in_progress:
            self._ending = True
            self.fleet.offer(work)
        else:
            self._end()
            self.commit()
        return generation

    def _close(self, now: float) -> None:
        closed = self._generations.close(self.generation, now - self.opened)
        self._untold.append(closed)
        reason = self._stop_reason()
        self.fleet.offer(self.slack.schedule(closed.number, self._generations.mean, now, last=reason is not None))
        # Opened also when the run ends here: a later life with wider limits then goes on from it.
        generation = self._generations.open(closed.number + 1)
        if generation.temperature != self.generation.temperature:
            self.fleet.notes.append(
                f"generation {generation.number} dreams at temperature {generation.temperature:g}: the evaluated mean "
                "fell"
            )
        self.generation, self.opened = generation, now
        self.fleet.begin(generation.number)
        if reason:
            self.fleet.withdraw("score")
            self._ending = True
        else:
            self.fleet.offer(generation.missing)

    def _count(self, work: Work, result: Result) -> None:
        """What an accepted result, which is in the journal, means to whatever asked for it."""
        if work.job.kind != "score":
            self.slack.count(work, result)
            return
        assert result.fitness is not None
        if self.generation.record(result.digest, result.fitness, result.steps):
            self.fleet.offer(self.generation.missing)

    def _stop_reason(self) -> str | None:
        return stop_reason(self.limits, self.history, self.slack.evaluations)

    def _end(self) -> None:
        self.ended = self._stop_reason() or "stopped"
        self._journal.set_fact("ended", self.ended)
        self.slack.report.finish()
