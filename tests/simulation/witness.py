"""Watches what is written: each row is compared with the truth as it comes."""

from __future__ import annotations

from typing import Any

from dreamfleet.common.protocol.messages import Job, JobBatch
from dreamfleet.common.runs.seeds import validation_seeds
from dreamfleet.coordinator.storage.verification_records import UNCHECKED
from tests.simulation.disk import Disk
from tests.simulation.schedule import Shape
from tests.simulation.truth import fails, fitness_of_job, truth_of
from tests.simulation.violation import Violation

Confirmed = tuple[str | None, set[bytes]]
"""The stored confirmation, and the digests of all results."""


class Witness:
    """Of one play, through all incarnations of its coordinator."""

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

    def counted(self, job: Job, fitness: float | None) -> None:
        """A result was accepted."""
        if fitness != fitness_of_job(job):
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
        for verdict in batch.verdicts:
            if verdict.verdict in ("accepted", "duplicate") and verdict.digest not in disk.durable:
                raise Violation("durability", f"a result was called {verdict.verdict} before it was on the disk")

    def confirmed(self, found: Confirmed, calm: Confirmed) -> None:
        """What is reported, and the tracks that it was confirmed on, are those of the play without faults."""
        if found[0] != calm[0] or (not self._shape.failing and found[1] != calm[1]):
            raise Violation("fitness", f"confirmed is {found[0]}, without faults {calm[0]}")

    def finished(self, disk: Disk) -> None:
        """All that was wanted is there, once."""
        closed = [number for (number,) in disk.read("SELECT number FROM generation WHERE closed IS NOT NULL")]
        if closed != list(range(self._shape.generations)):
            raise Violation("liveness", f"generations {closed} are closed, of {self._shape.generations}")
        if self._shape.verify == 1 and not self._shape.failing:  # what failed candidates have is checked no more
            self._all_checked(disk)
        if not self._shape.ends:
            return
        tracks = validation_seeds(self._shape.evaluation_episodes)
        rows = disk.read("SELECT kind, seed FROM result")
        counted = sum(kind != "evaluate" or seed in tracks for kind, seed in rows)  # and not on a confirmation's tracks
        if counted < self.truth.jobs or (counted > self.truth.jobs and not self._shape.failing):
            raise Violation("count", f"{counted} results are counted, of {self.truth.jobs} jobs")
        evaluated = {each.generation: each for each in disk.evaluations}
        if evaluated != self.truth.evaluations:
            raise Violation("fitness", f"evaluations are {evaluated}, without faults {self.truth.evaluations}")
        if disk.files != self.truth.rollouts:
            raise Violation("content", f"kept rollouts are {_sizes(disk.files)}, not {_sizes(self.truth.rollouts)}")

    def _all_checked(self, disk: Disk) -> None:
        """Where all results are drawn, each has an outcome once its generation is closed, or the run has ended."""
        closed = "kind = 'score' AND generation IN (SELECT number FROM generation WHERE closed IS NOT NULL)"
        due = "kind != 'collect'" if self._shape.ends else closed
        missing = disk.read(f"SELECT kind FROM result WHERE {due} {UNCHECKED}")
        if missing:
            kinds = ", ".join(sorted({kind for (kind,) in missing}))
            raise Violation("checked", f"{len(missing)} drawn results of what is closed were not checked ({kinds})")


def _sizes(files: dict[str, Any]) -> dict[str, int]:
    return {name: len(data) for name, data in files.items()}
