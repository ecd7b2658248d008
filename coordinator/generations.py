"""From the strategy to generations and back: what is asked is journalled, continued to the bit, and told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import JournalError
from dreamfleet.common.seeds import training_seed
from dreamfleet.common.stages import Stage, stages_of
from dreamfleet.common.stored import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.common.terms import Agenda, Terms
from dreamfleet.coordinator.evolution import Evolution, EvolutionConfig
from dreamfleet.coordinator.generation import Generation, Standing
from dreamfleet.coordinator.history import History
from dreamfleet.coordinator.jobs import travelling
from dreamfleet.coordinator.journal import Journal, OpenGeneration
from dreamfleet.coordinator.start import SUBSPACE, kept_start, kept_subspace


class Generations:
    """One generation is open at a time; `evaluations` are the finished ones, by generation, as they become known."""

    def __init__(
        self, journal: Journal, settings: RunSettings, agenda: Agenda, history: History,
        evaluations: Mapping[int, StoredEvaluation],
    ) -> None:  # fmt: skip
        self.history = history
        self.terms: Terms  # of the generation that is open
        self.last: Standing | None = None  # of the generation that was closed last
        self._journal = journal
        self._settings = settings
        self._agenda = agenda
        self._evaluations = evaluations
        self._subspace = kept_subspace(journal.fact(SUBSPACE), settings, journal.path)
        self._strategy = self._search(stages_of(settings)[0], kept_start(journal))

    @property
    def mean(self) -> bytes:
        """The distribution's mean as it would travel."""
        return travelling(self._strategy.mean)

    @property
    def sigma(self) -> float:
        """The strategy's overall step size."""
        return self._strategy.sigma

    @property
    def axis_ratio(self) -> float | None:
        """The longest axis of the strategy's distribution by the shortest; `None` where it does not say."""
        return self._strategy.axis_ratio

    def prepare(self) -> None:
        """Work ahead while workers are busy."""
        self._strategy.prepare()

    def begin(self) -> Generation:
        """The first generation of a new run, or the one that was open when the last incarnation ended."""
        stored = self._journal.last_generation()
        if stored is None:
            return self.open(0)
        before = self._journal.generation(stored.number - 1)
        earlier = None if before is None else self._terms(before.number)
        self.terms = self._terms(stored.number)
        if self.terms.stage.search > 1:
            self._strategy = self._search(self.terms.stage, self._strategy.mean)
        self._strategy.restore(stored.state)
        vectors = tuple(travelling(x) for x in self._strategy.ask())
        if vectors != stored.vectors:
            raise JournalError(
                f"generation {stored.number} cannot be continued: the strategy asks for another population than the "
                "journal holds; use the host and package versions that wrote it"
            )
        if before is not None and earlier is not None:
            self.last = self._recall(before, earlier).standing()
        return self._recall(stored, self.terms)

    def open(self, number: int) -> Generation:
        """Ask for the next population; it is written with the strategy's state from before."""
        self.terms = terms = self._terms(number)
        if number and terms.begun.since == number and terms.stage.anew:
            self._strategy = self._search(terms.stage, self._strategy.mean)
        state, sigma = self._strategy.state(), self._strategy.sigma
        vectors = [travelling(x) for x in self._strategy.ask()]
        seeds = [training_seed(self._settings.seed, number, episode) for episode in range(terms.stage.episodes)]
        self._journal.open_generation(number, state, sigma, seeds, vectors)
        return self._generation(number, vectors, seeds, terms)

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

    def _terms(self, number: int) -> Terms:
        return self._agenda.terms(number, self.history.rows, self._evaluations)

    def _search(self, stage: Stage, start: NDArray[np.float64] | None) -> Evolution:
        return Evolution(EvolutionConfig.of(self._settings, stage, self._subspace), start)

    def _recall(self, stored: OpenGeneration, terms: Terms) -> Generation:
        generation = self._generation(stored.number, stored.vectors, stored.seeds, terms)
        for digest, (fitness, steps) in self._journal.results_of("score", stored.number).items():
            generation.record(digest, fitness, steps)
        return generation

    def _generation(self, number: int, vectors: Sequence[bytes], seeds: Sequence[int], terms: Terms) -> Generation:
        own, stage = self._settings.task, terms.stage
        return Generation(
            number, terms.spec, vectors, seeds, racing=stage.racing, own=own, driven=stage.driven_episodes
        )
