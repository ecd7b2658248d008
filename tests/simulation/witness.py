"""Watches what is written: each row is compared with the truth as it comes."""

from __future__ import annotations

from typing import Any

from dreamfleet.common.protocol.messages import Job, JobBatch, Result
from dreamfleet.common.runs.seeds import validation_seeds
from tests.simulation.disk import Disk
from tests.simulation.schedule import Shape
from tests.simulation.truth import fails, fitness_of_job, truth_of
from tests.simulation.violation import Violation


class Witness:
    """Of one play, through all lives of its coordinator."""

    def __init__(self, shape: Shape) -> None:
        self.truth = truth_of(shape)
        self._shape = shape

    def opened(self, number: int, vectors: tuple[bytes, ...]) -> None:
        """A population was asked for."""
        if vectors != self.truth.vectors[number]:
            raise Violation("fitness", f"generation {number} has other candidates than without faults")

    def redrawn(self, number: int, rounds: int, vectors: tuple[bytes, ...]) -> None:
        """Failed candidates were drawn anew for the `rounds`-th time."""
        expected = self.truth.redrawn[number]
        if rounds > len(expected) or vectors != expected[rounds - 1]:
            raise Violation("fitness", f"round {rounds} of generation {number} draws other candidates")

    def counted(self, job: Job, result: Result) -> None:
        """A result was accepted."""
        if result.fitness != fitness_of_job(job):
            raise Violation("content", f"a {job.kind} of generation {job.generation} has a fitness of another content")

    def failed(self, job: Job) -> None:
        """A failure became a fact of the run."""
        if job.kind != "score" or not fails(self._shape.failing, job.vector, job.seeds[0]):
            raise Violation("content", f"a {job.kind} of generation {job.generation} that can be scored has failed")

    def check_fitness(self, number: int, fitness: list[float | None]) -> None:
        """The strategy got this fitness: compare it with the truth."""
        if fitness != self.truth.fitness[number]:
            expected = self.truth.fitness[number]
            raise Violation("fitness", f"generation {number} got fitness {fitness}, without faults {expected}")

    def evaluated(self, generation: int, mean: float, std: float) -> None:
        """An evaluation was finished."""
        expected = self.truth.evaluations[generation]
        if (mean, std) != (expected.mean, expected.std):
            what = f"the mean of generation {generation}"
            raise Violation("fitness", f"{what} is evaluated to {mean}, not {expected.mean}")

    def promised(self, disk: Disk, batch: JobBatch) -> None:
        """A batch leaves: what it says is counted must be on the disk, or a crash would take it back."""
        if not batch.verdicts:
            return
        surplus = {digest for (digest, _), (because, _) in disk.tables["recalled"].items() if because == "surplus"}
        for verdict in batch.verdicts:
            counts = verdict.verdict in ("accepted", "duplicate")
            if counts and verdict.digest not in disk.tables["result"] and verdict.digest not in surplus:
                raise Violation("durability", f"a result was called {verdict.verdict} before it was on the disk")

    def confirmed(self, disk: Disk, calm: Disk) -> None:
        """What is reported, and the tracks that it was confirmed on, are those of the play without faults."""
        facts = [each.tables["fact"].get("confirmed") for each in (disk, calm)]
        results = [each.tables["result"].keys() for each in (disk, calm)]
        if facts[0] != facts[1] or (not self._shape.failing and results[0] != results[1]):
            raise Violation("fitness", f"confirmed is {facts[0]}, without faults {facts[1]}")

    def finished(self, disk: Disk) -> None:
        """All that was wanted is there, once."""
        closed = [number for number, row in disk.tables["generation"].items() if "closed" in row]
        if closed != list(range(self._shape.generations)):
            raise Violation("liveness", f"generations {closed} are closed, of {self._shape.generations}")
        if self._shape.verify == 1 and not self._shape.failing:  # what failed candidates have is checked no more
            self._all_checked(disk, closed)
        if not self._shape.ends:
            return
        confirming = [job for job, *_ in disk.tables["result"].values() if _confirms(job, self._shape)]
        counted = len(disk.tables["result"]) - len(confirming)
        if counted < self.truth.jobs or (counted > self.truth.jobs and not self._shape.failing):
            raise Violation("count", f"{counted} results are counted, of {self.truth.jobs} jobs")
        evaluated = {number: done for number, (_, done) in disk.tables["evaluation"].items()}
        if evaluated != self.truth.evaluations:
            raise Violation("fitness", f"evaluations are {evaluated}, without faults {self.truth.evaluations}")
        if disk.files != self.truth.rollouts:
            raise Violation("content", f"kept rollouts are {_sizes(disk.files)}, not {_sizes(self.truth.rollouts)}")

    def _all_checked(self, disk: Disk, closed: list[int]) -> None:
        """Where all results are drawn, each has an outcome once its generation is closed, or the run has ended."""
        jobs = {digest: job for digest, (job, *_) in disk.tables["result"].items() if job.kind != "collect"}
        missing = [job for digest, job in jobs.items() if digest not in disk.tables["verification"]
                   and (self._shape.ends or (job.kind == "score" and job.generation in closed))]  # fmt: skip
        if missing:
            kinds = ", ".join(sorted({job.kind for job in missing}))
            raise Violation("checked", f"{len(missing)} drawn results of what is closed were not checked ({kinds})")


def _confirms(job: Job, shape: Shape) -> bool:
    """Whether an evaluation is on other tracks than the schedule's."""
    return job.kind == "evaluate" and job.seeds[0] not in validation_seeds(shape.evaluation_episodes)


def _sizes(files: dict[str, Any]) -> dict[str, int]:
    return {name: len(data) for name, data in files.items()}
