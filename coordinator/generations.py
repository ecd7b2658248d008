"""From the strategy to generations and back: what is asked is journalled, continued to the bit, and told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dreamfleet.common.errors import JournalError
from dreamfleet.common.heat import Heat
from dreamfleet.common.seeds import training_seed
from dreamfleet.common.stored import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.coordinator.evolution import Evolution
from dreamfleet.coordinator.generation import Generation, Standing
from dreamfleet.coordinator.history import History
from dreamfleet.coordinator.jobs import travelling
from dreamfleet.coordinator.journal import Journal, OpenGeneration


class Generations:
    """One generation is open at a time; `evaluations` are the finished ones, by generation, as they become known."""

    def __init__(
        self, journal: Journal, settings: RunSettings, strategy: Evolution, history: History,
        evaluations: Mapping[int, StoredEvaluation],
    ) -> None:  # fmt: skip
        self.history = history
        self.last: Standing | None = None  # of the generation that was closed last
        self._journal = journal
        self._settings = settings
        self._strategy = strategy
        self._heat = Heat(settings)
        self._evaluations = evaluations

    @property
    def mean(self) -> bytes:
        """The distribution's mean as it would travel."""
        return travelling(self._strategy.mean)

    def begin(self) -> Generation:
        """The first generation of a new run, or the one that was open when the last incarnation ended."""
        stored = self._journal.last_generation()
        if stored is None:
            return self.open(0)
        self._strategy.restore(stored.state)
        vectors = tuple(travelling(x) for x in self._strategy.ask())
        if vectors != stored.vectors:
            raise JournalError(
                f"generation {stored.number} cannot be continued: the strategy asks for another population than the "
                "journal holds; use the host and package versions that wrote it"
            )
        before = self._journal.generation(stored.number - 1)
        if before is not None:
            self.last = self._recall(before).standing()
        return self._recall(stored)

    def open(self, number: int) -> Generation:
        """Ask for the next population; it is written with the strategy's state from before."""
        state, sigma = self._strategy.state(), self._strategy.sigma
        vectors = [travelling(x) for x in self._strategy.ask()]
        seeds = [training_seed(self._settings.seed, number, episode) for episode in range(self._settings.episodes)]
        self._journal.open_generation(number, state, sigma, seeds, vectors)
        return self._generation(number, vectors, seeds)

    def close(self, generation: Generation, seconds: float) -> StoredGeneration:
        """Tell the strategy what the generation gave; it took so many seconds."""
        fitness = generation.fitness()
        closed = StoredGeneration(
            number=generation.number,
            mean=float(fitness.mean()),
            std=float(fitness.std()),
            best=float(fitness.max()),
            worst=float(fitness.min()),
            sigma=self._strategy.sigma,
            steps=generation.steps,
            seconds=seconds,
        )
        self._strategy.tell(fitness)
        self._journal.close_generation(closed, fitness)
        self.history.append(closed)
        self.last = generation.standing()
        return closed

    def _recall(self, stored: OpenGeneration) -> Generation:
        generation = self._generation(stored.number, stored.vectors, stored.seeds)
        for digest, (fitness, steps) in self._journal.results_of("score", stored.number).items():
            generation.record(digest, fitness, steps)
        return generation

    def _generation(self, number: int, vectors: Sequence[bytes], seeds: Sequence[int]) -> Generation:
        settings, spec = self._settings, self._heat.spec(number, self._evaluations)
        return Generation(number, spec, vectors, seeds, racing=settings.racing, own=settings.task)
