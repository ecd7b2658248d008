"""The generations of a run without a search of its own: each is a batch that somebody submitted. Pages: ask-tell.md."""

from typing import cast

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.runs.records import StoredGeneration
from dreamfleet.common.runs.stages import Stage
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint, Head
from dreamfleet.coordinator.optimisers.evolution import Evolution
from dreamfleet.coordinator.run.generations import Generations, fitness_statistics

CANCELLED = "cancelled"  # the error of a candidate that was not scored when its batch was cancelled


class NoSearch:
    """Stands where other runs have their search: it asks for nothing and learns nothing."""

    sigma = 0.0
    axis_ratio = None

    def __init__(self, dimension: int) -> None:
        self.mean: NDArray[np.float64] = np.zeros(dimension)

    def prepare(self) -> None:
        """Nothing is ever prepared."""

    def state(self) -> Checkpoint:
        """A state without content, since the journal keeps one with each generation."""
        return Checkpoint(Head("external", "external", self.mean, self.sigma), {})


class ExternalGenerations(Generations):
    """Opens a generation for each batch, oldest first; while none waits, the open generation is empty."""

    def begin(self) -> Generation:
        """Restore the open batch of the last incarnation, or open the next one."""
        self._journal.results.index_scores()
        stored = self._journal.last_generation()
        self.begun = self._stage_at(len(self.history))
        if stored is None or self._journal.is_closed(stored.number):
            return self.open(len(self.history))
        self.seconds = stored.seconds
        return self.reload(stored.number)

    def open(self, number: int) -> Generation:
        """Open the batch that has waited longest as generation `number`; without one, an empty generation."""
        self.begun = self._stage_at(number)
        batch = self._journal.batches.next_waiting()
        if batch is None:
            return self._generation(number, (), (), self.begun)
        vectors, search = self._journal.batches.vectors(batch), self._strategy
        self._journal.open_generation(number, search.state(), search.sigma, batch.seeds, vectors)
        self._journal.batches.begin(batch.id, number)
        return self._with_known_results(self._generation(number, vectors, batch.seeds, self.begun))

    def reload(self, number: int) -> Generation:
        """The open generation as the journal has it."""
        generation = self._with_known_results(super().reload(number))
        batch = self._journal.batches.of(number)
        if batch is not None and batch.state == "cancelled":
            generation.cancel()
        return generation

    def close(self, generation: Generation, seconds: float) -> StoredGeneration:
        """Journal the batch's fitness and the generation, which took `seconds`."""
        fitness, batch = generation.fitness(), self._journal.batches.of(generation.number)
        closed = StoredGeneration(
            number=generation.number, **fitness_statistics(fitness), sigma=self._strategy.sigma,
            steps=generation.steps, seconds=seconds, failed=len(generation.failed),
        )  # fmt: skip
        self._journal.close_generation(closed, fitness)
        if batch is not None:
            self._journal.batches.finish(batch.id, self.find_errors(generation, generation.without_fitness))
        self.history.append(closed)
        self.last, self._scored_before = generation.candidate_scores(), generation.find_scored() or self._scored_before
        return closed

    def find_errors(self, generation: Generation, candidates: list[int]) -> dict[int, str]:
        """Why each of these candidates of the open generation has no fitness."""
        wanted = set(candidates)
        digests = [each.digest for each in generation.work if each.template.candidate in wanted]
        found = self._journal.results.errors_of(digests)
        named: dict[int, str] = {}
        for work in generation.work:
            if work.template.candidate in wanted and work.digest in found:
                named.setdefault(work.template.candidate, found[work.digest])
        return {each: named.get(each, CANCELLED) for each in candidates}

    def can_reseed(self, _generation: Generation) -> bool:
        """Never: the seeds are the submitter's."""
        return False

    def _search(self, _stage: Stage, _start: NDArray[np.float64] | None) -> Evolution:
        return cast(Evolution, NoSearch(self._settings.controller.size))

    def _with_known_results(self, generation: Generation) -> Generation:
        """Count results of other batches: R1, a job's digest names its content, so nothing is scored twice.

        Their steps belong to the generation that made them.
        """
        known = self._journal.fitness_of("score", generation.missing)
        generation.recall({digest: (fitness, 0, ()) for digest, fitness in known.items()})
        return generation
