"""A run's generations: ask the strategy for a population, journal it, and return the fitness to the strategy."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.client.elite_archive import EliteArchive
from dreamfleet.common.errors import JournalError
from dreamfleet.common.protocol.tasks import is_function_task
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.seeds import MAX_RESEEDS, count_reseeds, training_seeds
from dreamfleet.common.runs.stages import BegunStage, Stage, StageTracker, stages_of
from dreamfleet.coordinator.jobs.generation import CandidateScores, Generation
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob, vector_bytes
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint
from dreamfleet.coordinator.optimisers.evolution import Evolution
from dreamfleet.coordinator.settings.start import SUBSPACE_FACT, stored_start_mean, stored_subspace
from dreamfleet.coordinator.storage.journal import Journal, StoredOpenGeneration

MAX_REDRAWS = 3  # rounds in a generation; what fails after them ranks last; docs/how-to/unattended.md
RECENT = 5  # generations, the open one included, whose failures `--failure-limit` counts; settings/network.py


class Generations:
    """Opens and closes generations, one at a time. `evaluations` maps a generation to its finished evaluation."""

    def __init__(
        self, journal: Journal, settings: RunSettings, agenda: StageTracker, history: History,
        evaluations: Mapping[int, StoredEvaluation],
    ) -> None:  # fmt: skip
        self.history = history
        self.begun: BegunStage  # of the open generation
        self.last: CandidateScores | None = None  # of the last closed generation
        self.redrawn: set[int] = set()  # candidates of the open generation that failed and were drawn anew
        self.seconds = 0.0  # for which the restored generation could be scored before
        self._rounds = 0  # in which candidates were drawn anew
        self._reseeds = 0  # times that the open generation got other seeds
        self._scored_before: ScoringJob | None = None  # a job of the last generation that has a score
        self._journal = journal
        self._settings = settings
        self._agenda = agenda
        self._evaluations = evaluations
        self._subspace = stored_subspace(journal.fact(SUBSPACE_FACT), settings, journal.path)
        self._first_mean = stored_start_mean(journal)
        self._strategy = self._search(stages_of(settings)[0], self._first_mean)
        self.archive = EliteArchive.empty(settings)  # of the closed generations
        for each in history.rows if self.archive is not None else ():
            self._add_elites(each.number, *journal.scores_of(each.number, len(settings.archive)))

    @property
    def mean(self) -> bytes:
        """The distribution's mean `(size,)` as float32 bytes."""
        return vector_bytes(self._strategy.mean)

    @property
    def sigma(self) -> float:
        """The strategy's overall step size."""
        return self._strategy.sigma

    @property
    def axis_ratio(self) -> float | None:
        """Ratio of the distribution's longest axis to its shortest; `None` if the strategy does not provide it."""
        return self._strategy.axis_ratio

    @property
    def stage_text(self) -> str:
        """The open generation's stage, in words."""
        stage = self.begun.stage
        return f"stage {stage.number} of {len(self._agenda)} ({stage.description})"

    @property
    def stage_note(self) -> str | None:
        """That the open generation begins a stage, and why, in words; `None` if it does not."""
        begun, number = self.begun, len(self.history)
        if begun.since != number:
            return None
        origin = "" if begun.origin is None else f", from the mean of generation {begun.origin}"
        return f"{self.stage_text} begins with generation {number} after {begun.why}{origin}"

    def prepare(self) -> None:
        """Prepare the next population while workers are busy."""
        self._strategy.prepare()

    def begin(self) -> Generation:
        """Open the first generation of a new run, or restore the one that was open when the last incarnation ended."""
        stored = self._journal.last_generation()
        if stored is None:
            return self.open(0)
        before = self._journal.generation(stored.number - 1)
        earlier = None if before is None else self._stage_at(before.number)
        self.begun = self._stage_at(stored.number)
        if self.begun.stage.search > 1:
            self._strategy = self._search(self.begun.stage, self._strategy.mean)
        self._strategy.restore(stored.state)
        population = self._strategy.ask()
        for indices in stored.redrawn:
            population[list(indices)] = self._strategy.redraw(indices)
        self.seconds = stored.seconds
        self.redrawn = {index for indices in stored.redrawn for index in indices}
        self._rounds = len(stored.redrawn)
        self._reseeds = count_reseeds(self._settings.seed, stored.number, stored.seeds)
        vectors = tuple(vector_bytes(x) for x in population)
        if vectors != stored.vectors:
            raise JournalError(
                f"generation {stored.number} cannot be continued: the strategy asks for another population than the "
                "journal holds; use the host and package versions that wrote it"
            )
        if before is not None and earlier is not None:
            closed = self._recall(before, earlier)
            self.last, self._scored_before = closed.candidate_scores(), closed.find_scored()
        return self._recall(stored, self.begun)

    def open(self, number: int) -> Generation:
        """Ask for the next population and journal it with the strategy's state before that."""
        begun = self._begin_search(number)
        state, sigma = self._strategy.state(), self._strategy.sigma
        vectors = [vector_bytes(x) for x in self._strategy.ask()]
        seeds = training_seeds(self._settings.seed, number, begun.stage.settings.episodes)
        self._journal.open_generation(number, state, sigma, seeds, vectors)
        self.redrawn, self._rounds, self._reseeds = set(), 0, 0
        may_have_results = self._journal.recalls.has_set_aside
        generation = self._generation(number, vectors, seeds, begun, in_parts=not may_have_results)
        if may_have_results:
            self._journal.recalls.count_again(generation.work)
            generation.recall(self._journal.results.of("score", number))
        return generation

    def replay(self, number: int) -> Checkpoint:
        """The strategy's state before it asked for generation `number`, from what the journal says that it was given.

        Only of a new object: the strategy begins at generation 0. `JournalError` if it asks for other populations.
        """
        for each in range(number):
            self._begin_search(each)
            population = self._strategy.ask()
            for indices in self._journal.redraws_of(each):
                population[indices] = self._strategy.redraw(indices)
            if tuple(vector_bytes(x) for x in population) != self._journal.vectors_of(each):
                raise JournalError(
                    f"the run cannot be rewound: in generation {each} the strategy asks for another population than "
                    "the journal holds; use the host and package versions that wrote it"
                )
            fitness, measures = self._journal.scores_of(each, len(self._settings.archive))
            self._strategy.tell(_ranked(fitness, fitness_statistics(fitness)["worst"]), measures)
        self._begin_search(number)
        return self._strategy.state()

    def close(self, generation: Generation, seconds: float) -> StoredGeneration:
        """Give the strategy the generation's fitness and journal the generation, which took `seconds`.

        R8: failed candidates rank last. Their fitness for the strategy is the next number below the worst.
        """
        fitness, measures = generation.fitness(), generation.measures()
        statistics = fitness_statistics(fitness)
        closed = StoredGeneration(
            number=generation.number, **statistics, sigma=self._strategy.sigma, steps=generation.steps,
            seconds=seconds, failed=self.count_failed(generation),
        )  # fmt: skip
        self._strategy.tell(_ranked(fitness, statistics["worst"]), measures)
        self._journal.recalls.set_surplus_aside(generation.number, generation.surplus)
        self._journal.close_generation(closed, fitness, measures)
        self._add_elites(closed.number, fitness, measures)
        self.history.append(closed)
        self.last, self._scored_before = generation.candidate_scores(), generation.find_scored()
        return closed

    def _add_elites(self, number: int, fitness: NDArray[np.float64], measures: NDArray[np.float64] | None) -> None:
        if self.archive is None or measures is None:
            return
        for index in np.flatnonzero(np.isfinite(fitness) & np.isfinite(measures).all(axis=1)).tolist():
            self.archive.add(number, index, float(fitness[index]), measures[index].tolist())

    def can_try_again(self, generation: Generation) -> bool:
        """Whether `try_again` would change the generation as its failures are now."""
        return self.can_reseed(generation) or (bool(generation.failed) and self._can_redraw)

    def can_reseed(self, generation: Generation) -> bool:  # docs/how-to/troubleshooting.md
        """Whether `try_again` would give the generation other seeds.

        One call of a function for each candidate looks for no seed: other ones would fail alike.
        """
        is_call = is_function_task(self._settings.task.task) and generation.episodes == 1
        return generation.has_bad_seeds and self._reseeds < MAX_RESEEDS and not is_call

    @property
    def _can_redraw(self) -> bool:
        return self._settings.on_failure == "redraw" and self._rounds < MAX_REDRAWS

    def try_again(self, generation: Generation) -> str | None:
        """Change the complete, open generation in the journal because of its failures; what changed, in words.

        R8: if all candidates failed that were to drive all episodes, the generation gets other seeds. Else, with
        `redraw`, the failed ones are drawn anew. `None` if neither is to be done, or if it was done often enough. All
        others are scored, so the change does not depend on the order of arrival. `reload` returns the changed
        generation.
        """
        number, indices = generation.number, generation.failed
        if self.can_reseed(generation):
            self._reseeds += 1
            seeds = training_seeds(self._settings.seed, number, generation.episodes, self._reseeds)
            self._journal.set_seeds(number, seeds)
            who = "all candidates" if generation.all_failed else "all candidates of the better half"
            return f"{who} failed in generation {number}: it gets other seeds"
        if not (indices and self._can_redraw):
            return None
        self._rounds += 1
        self.redrawn.update(indices)
        self._journal.redraw(number, indices, [vector_bytes(x) for x in self._strategy.redraw(indices)])
        names = f"candidate {indices[0]}" if len(indices) == 1 else f"candidates {', '.join(map(str, indices))}"
        return f"{names} of generation {number} failed and {'is' if len(indices) == 1 else 'are'} redrawn"

    def count_recent_failures(self, generation: Generation, since: int) -> tuple[int, range]:
        """Failed candidates of the open generation and those before it, and the generations that were counted.

        They are at most `RECENT` generations of one stage, from `since` on.
        """
        first = max(since, self.begun.since, generation.number - RECENT + 1)
        counted = range(first, generation.number + 1)
        opened = self.count_failed(generation) if counted else 0
        return sum(each.failed for each in self.history.rows[first:]) + opened, counted

    def count_failed(self, generation: Generation) -> int:
        """The candidates of the open generation that failed, those that were drawn anew included."""
        return len(self.redrawn.union(generation.failed))

    def find_scored(self, generation: Generation) -> ScoringJob | None:
        """A job of the open generation or the last one that has a score; `None` if there is none."""
        return generation.find_scored() or self._scored_before

    def reload(self, number: int) -> Generation:
        """The open generation as the journal has it."""
        stored = self._journal.generation(number)
        assert stored is not None  # the open generation is never deleted
        return self._recall(stored, self.begun)

    def _begin_search(self, number: int) -> BegunStage:
        """The stage of a generation that opens; it may begin with a new search."""
        self.begun = begun = self._stage_at(number)
        if number and begun.since == number and begun.stage.starts_new_search:
            self._strategy = self._search(begun.stage, self._start_of(begun))
        return begun

    def _start_of(self, begun: BegunStage) -> NDArray[np.float64] | None:
        """Where a new search starts; `None`: at zeros."""
        if begun.origin is not None:
            return np.frombuffer(self._journal.evaluated_vector(begun.origin), dtype="<f4").astype(np.float64)
        return self._first_mean if begun.stage.restart else self._strategy.mean

    def _stage_at(self, number: int) -> BegunStage:
        return self._agenda.advance_to(number, self.history.rows, self._evaluations)

    def _search(self, stage: Stage, start: NDArray[np.float64] | None) -> Evolution:
        return Evolution.of(self._settings, stage, self._subspace, start)

    def _recall(self, stored: StoredOpenGeneration, begun: BegunStage) -> Generation:
        generation = self._generation(stored.number, stored.vectors, stored.seeds, begun)
        generation.recall(self._journal.results.of("score", stored.number))
        return generation

    def _generation(
        self, number: int, vectors: Sequence[bytes], seeds: Sequence[int], begun: BegunStage, *,
        in_parts: bool = False,
    ) -> Generation:  # fmt: skip
        stage = begun.stage
        return Generation(
            number, stage.settings.task, vectors, seeds, racing=stage.settings.racing, run_spec=self._settings.task,
            driven=stage.driven_episodes, in_parts=in_parts,
        )  # fmt: skip


def _ranked(fitness: NDArray[np.float64], worst: float) -> NDArray[np.float64]:
    """The fitness for the strategy: failed candidates get the next number below the `worst` (R8)."""
    return np.where(np.isfinite(fitness), fitness, np.nextafter(worst, -np.inf))


def fitness_statistics(fitness: NDArray[np.float64]) -> dict[str, float]:  # docs/how-to/export.md
    """Mean, spread, best and worst of the candidates that have a fitness; 0 if none has one."""
    found = fitness[np.isfinite(fitness)]
    if not len(found):
        return dict.fromkeys(("mean", "std", "best", "worst"), 0.0)
    return {
        "mean": float(found.mean()), "std": float(found.std()), "best": float(found.max()), "worst": float(found.min())
    }  # fmt: skip
