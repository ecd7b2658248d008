"""A run's folder on disk, read-only: its journal's contents as typed records. Only the coordinator writes a run."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from difflib import SequenceMatcher
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import JournalError
from dreamfleet.common.files.regular_files import path_exists
from dreamfleet.common.printable import join_some
from dreamfleet.common.protocol.check_counts import CheckCounts
from dreamfleet.common.protocol.host_classes import HostClasses, count_results
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.result_bounds import clamp_count, to_finite
from dreamfleet.common.protocol.stop_kind import StopKind
from dreamfleet.common.runs.effort import START_EFFORT, Effort, GenerationEffort, parse_start_effort
from dreamfleet.common.runs.journal.candidate_counts import CandidateCounts
from dreamfleet.common.runs.journal.journal_check import JournalCheck
from dreamfleet.common.runs.journal.journal_reader import (
    CLASS_COUNTS_QUERY,
    RESULTS_QUERY,
    WORK_QUERY,
    JournalReader,
    efforts_query,
)
from dreamfleet.common.runs.records import (
    RunSettings,
    StoredCandidate,
    StoredConfirmation,
    StoredEvaluation,
    StoredEvent,
    StoredFailure,
    StoredGeneration,
    StoredResult,
    WorkerEffort,
    best_evaluation,
)
from dreamfleet.common.runs.run_lock import is_run_locked
from dreamfleet.common.runs.run_paths import BUNDLE, CONTROLLER, JOURNAL, rollout_path, run_paths
from dreamfleet.common.runs.seeds import CHOOSING_OFFSET, CONFIRMING_OFFSET, VALIDATION, count_reseeds
from dreamfleet.common.runs.stages import BegunStage, begun_stages, stage_at
from dreamfleet.common.schema.times import elapsed_seconds

MAX_LISTED_RUNS = 8  # in the error for an unknown run name
# Names of facts in the journal.
CONFIRMED = "confirmed"  # the confirmed score
ENDED_AT = "ended_at"  # the time when the run ended
EPISODE_LIMIT = "episode_limit"  # steps after which the environment itself ends an episode
ENDING = "ending"  # the limit that ended the run; set while the last evaluations still run, and kept
STOP_KIND = "stop_kind"  # of that limit, a `StopKind`


def open_run(runs_dir: Path, name: str) -> RunFolder:
    """Open a run by name; `JournalError` for an unknown one lists the most similar names."""
    path = runs_dir / check_run_name(name)
    if not path_exists(path / JOURNAL):
        names = [each.name for each in run_paths(runs_dir)]
        names.sort(key=lambda each: -SequenceMatcher(None, name, each).quick_ratio())
        raise JournalError(
            f"no run {name!r} in {runs_dir}; there are: {join_some(names, MAX_LISTED_RUNS) or 'none yet'}"
        )
    return RunFolder(path)


class RunFolder:
    """A run's folder, read-only; close it, or use it in a `with`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = path.name
        self._journal = JournalReader(path / JOURNAL)
        self._check = JournalCheck(self._journal)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the journal."""
        self._journal.close()

    def read_transaction(self) -> AbstractContextManager[None]:
        """A context in which all reads see one state of the journal, whatever a coordinator writes meanwhile."""
        return self._journal.transaction()

    def verify(self) -> None:
        """Compare the whole journal with its checksums, and its generations with their results' sums.

        `DamagedJournalError` if anything differs. It reads everything, some seconds for a million results.
        """
        with self.read_transaction():
            history = self.history()
            counts = CandidateCounts(self._journal, self.settings, history, self.evaluations())
            self._check.check_all(history, counts, self.training_seeds)

    @contextmanager
    def verified_transaction(self) -> Iterator[None]:
        """`read_transaction` of a journal that was verified: just now, or by the coordinator that serves it."""
        with self.read_transaction():
            if not is_run_locked(self.path):
                self.verify()
            yield

    @property
    def settings(self) -> RunSettings:
        """The settings that are frozen with the run."""
        return RunSettings.from_json(self.fact("settings") or "")

    @property
    def spec(self) -> TaskSpec:
        """The task that candidates are scored in."""
        return self.settings.task

    @property
    def state(self) -> str:
        """`ended: REASON`; else `live` while a coordinator of this host holds the run's lock; else `open`."""
        ended = self.ended
        return f"ended: {ended}" if ended else "live" if is_run_locked(self.path) else "open"

    @property
    def uid(self) -> str:
        """The random identity of the run."""
        return self.fact("uid") or ""

    @property
    def created(self) -> str:
        """When the run began, ISO 8601, UTC."""
        return self.fact("created") or ""

    @property
    def fingerprint(self) -> str | None:
        """The host fingerprint of the first accepted result, which a strict run requires of every host."""
        return self.fact("fingerprint")

    @property
    def ended(self) -> str | None:
        """Why the run ended, or `None` if it did not."""
        return self.fact("ended")

    @property
    def stop_kind(self) -> StopKind | None:
        """What ended the run; `None` if it did not end."""
        return StopKind.parse(self.fact(STOP_KIND)) if self.ended else None

    @property
    def ended_at(self) -> str | None:
        """When the run ended, ISO 8601, UTC; `None` if it did not."""
        return self.fact(ENDED_AT) if self.ended else None

    @property
    def duration_seconds(self) -> float | None:
        """Seconds from the run's beginning to its end, pauses included; `None` if they are unknown."""
        return elapsed_seconds(self.created, self.ended_at or "")

    @property
    def classes(self) -> HostClasses:
        """The host classes of the accepted results."""
        return HostClasses.of(count_results(self._journal.rows("ssi", CLASS_COUNTS_QUERY)))

    @property
    def checks(self) -> CheckCounts | None:
        """What came of checking results on other hosts; `None` if nothing is checked and nobody is barred."""
        try:
            share = float(json.loads(self.fact("network") or "{}").get("verify", 0.0))
        except (ValueError, TypeError, AttributeError):
            share = 0.0
        return self._journal.check_counts(share)

    @property
    def bundle_path(self) -> Path:
        """The run's own copy of its world model."""
        return self.path / BUNDLE

    @property
    def controller_path(self) -> Path:
        """The reported controller; the file exists once a generation is closed."""
        return self.path / CONTROLLER

    def candidate(self, generation: int, number: int) -> NDArray[np.float32]:
        """A candidate's parameters `(size,)`, as the workers received them."""
        query = "SELECT vector FROM candidate WHERE generation = ? AND number = ?"
        return self._vector(f"candidate {generation}/{number}", query, generation, number)

    def evaluated_mean(self, generation: int) -> NDArray[np.float32]:
        """The mean `(size,)` after an evaluated generation, as the workers received it."""
        query = "SELECT vector FROM evaluation WHERE generation = ?"
        return self._vector(f"evaluation of generation {generation}", query, generation)

    def fitness(self, generation: int, number: int) -> float | None:
        """A candidate's fitness; `None` while its generation is open, or if it failed."""
        query = "SELECT fitness FROM candidate WHERE generation = ? AND number = ?"
        rows = self._journal.rows("F", query, generation, number)
        return rows[0][0] if rows else None

    def results(self, generation: int, number: int, kind: str = "score") -> list[StoredResult]:
        """A candidate's accepted results, by episode; also those of a vector that was discarded and drawn anew."""
        rows = self._journal.rows("siiiififssss", RESULTS_QUERY, kind, generation, number)
        return [StoredResult(*row) for row in rows]

    def candidates(self) -> list[StoredCandidate]:
        """Every candidate by generation and number."""
        with self.read_transaction():
            counts = CandidateCounts(self._journal, self.settings, self.history(), self.evaluations())
            generations = self._journal.rows("ii", "SELECT number, closed IS NULL FROM generation ORDER BY number")
            if [number for number, _ in generations] != [*range(len(generations))]:
                raise self._journal.damage_error("a generation is missing")
            return [
                each
                for number, is_open in generations
                for each in counts.rows(number, self.training_seeds(number), is_open=bool(is_open))
            ]

    def measured_candidates(self, since: int = 0) -> list[tuple[int, int, float, tuple[float, ...]]]:
        """Generation, number, fitness and measures of the candidates that have measures, in the order of the run.

        They are those of the closed generations from `since` on.
        """
        query = (
            "SELECT generation, number, fitness, measures FROM candidate WHERE generation >= ? "
            "AND measures IS NOT NULL AND fitness IS NOT NULL ORDER BY generation, number"
        )
        try:
            return [
                (generation, number, to_finite(fitness), tuple(float(each) for each in json.loads(measures)))
                for generation, number, fitness, measures in self._journal.rows("iifs", query, since)
            ]
        except (ValueError, TypeError, RecursionError) as error:
            raise self._journal.damage_error("a candidate's measures are no numbers") from error

    def scores(self, generation: int, *, confirming: bool = False) -> dict[int, float]:
        """The scores of a generation's mean by validation seed, in its evaluation or in its confirmation.

        A run that has converged evaluates one mean several times, and its results are stored with the first generation.
        """
        since, until = (CONFIRMING_OFFSET, VALIDATION.stop) if confirming else (0, CHOOSING_OFFSET)
        query = (
            "SELECT seed, fitness FROM result WHERE kind = 'evaluate' AND episode BETWEEN ?2 AND ?3 AND generation IN "
            "(SELECT generation FROM evaluation WHERE vector = (SELECT vector FROM evaluation WHERE generation = ?1))"
        )
        return dict(self._journal.rows("if", query, generation, since, until - 1))

    def training_seeds(self, generation: int) -> tuple[int, ...]:
        """The seed of each episode of a generation; the last ones, if all candidates failed on earlier ones."""
        row = self._journal.row("SELECT seeds FROM generation WHERE number = ?", generation)
        with suppress(TypeError, ValueError, RecursionError):
            seeds = json.loads(row[0])
            if isinstance(seeds, list) and all(isinstance(each, int) for each in seeds):
                return tuple(seeds)
        raise self._journal.damage_error(f"generation {generation} has no seeds")

    def count_reseeds(self, history: Iterable[StoredGeneration]) -> int:
        """The sets of seeds in these generations that others replaced, because all candidates failed on them."""
        found, run_seed = 0, self.settings.seed
        for each in history:
            with suppress(JournalError):  # damaged seeds: the rest of the run can be shown
                found += count_reseeds(run_seed, each.number, self.training_seeds(each.number))
        return found

    def result_count(self) -> int:
        """Accepted results of every kind."""
        return int(self._journal.row("SELECT count(*) FROM result")[0])

    def history(self, since: int = 0) -> list[StoredGeneration]:
        """Every closed generation from number `since` on, oldest first."""
        query = (
            "SELECT number, mean, std, best, worst, sigma, steps, seconds, failed FROM generation "
            "WHERE closed IS NOT NULL AND number >= ? ORDER BY number"
        )
        self._check.check_generations(since)
        rows = self._journal.rows("iFFFFfiFi", query, since)
        return [
            StoredGeneration(
                number, to_finite(mean), to_finite(std), to_finite(best), to_finite(worst), to_finite(sigma),
                clamp_count(steps), to_finite(seconds), clamp_count(failed),
            )
            for number, mean, std, best, worst, sigma, steps, seconds, failed in rows
        ]  # fmt: skip

    def unscored_generations(self) -> set[int]:
        """The closed generations without a mean fitness, which `history` gives as 0."""
        rows = self._journal.rows("i", "SELECT number FROM generation WHERE closed IS NOT NULL AND mean IS NULL")
        return {number for (number,) in rows}

    def quartiles(self, generations: Iterable[int]) -> dict[int, tuple[float, float]]:
        """The lower and upper quartile of the candidates' fitness, by generation; open generations are left out."""
        query = "SELECT fitness FROM candidate WHERE generation = ? AND fitness IS NOT NULL"
        rows = ((number, self._journal.rows("f", query, number)) for number in generations)
        scored = {number: [to_finite(fitness) for (fitness,) in found] for number, found in rows if found}
        quartiles = {number: np.percentile(fitness, (25, 75)).tolist() for number, fitness in scored.items()}
        return {number: (low, high) for number, (low, high) in quartiles.items()}

    def evaluations(self) -> list[StoredEvaluation]:
        """Every finished evaluation of a mean, oldest first."""
        query = (
            "SELECT generation, episodes, mean, std, failed FROM evaluation WHERE mean IS NOT NULL ORDER BY generation"
        )
        self._check.check_evaluations()
        rows = self._journal.rows("iiFFi", query)
        if any(not 0 <= failed < episodes for _, episodes, _, _, failed in rows):
            raise self._journal.damage_error("an evaluation is of no episodes")
        return [StoredEvaluation(generation, episodes - failed, to_finite(mean), to_finite(std), failed)
                for generation, episodes, mean, std, failed in rows]  # fmt: skip

    def events(self) -> list[StoredEvent]:
        """What happened to the run, oldest first: workers that came and went, pauses, failures, incarnations."""
        query = (
            "SELECT happened, incarnation, substr(text, 1, 1000), substr(what, 1, 100), substr(worker, 1, 100) "
            "FROM event ORDER BY number"
        )
        return [StoredEvent(*row) for row in self._journal.rows("fisss", query)]

    def failures(self) -> list[StoredFailure]:
        """Every episode that has no score because it failed everywhere, oldest first."""
        query = (
            "SELECT kind, generation, candidate, episode, seed, substr(error, 1, 1000), substr(cause, 1, 1000), "
            "substr(fault, 1, 10), substr(workers, 1, 1000), attempts, happened, hex(digest) FROM failure "
            "ORDER BY happened, generation, candidate, episode"
        )
        return [StoredFailure(*row) for row in self._journal.rows("siiiissssifs", query)]

    def confirmation(self) -> StoredConfirmation | None:
        """The confirmed score of the reported mean; `None` if that mean is not confirmed."""
        text, evaluations = self.fact(CONFIRMED), self.evaluations()
        if text is None:
            return None
        found = StoredConfirmation.from_json(text)
        return found if found.covers(best_evaluation(evaluations)) else None

    def reported(self) -> StoredConfirmation | StoredEvaluation | None:
        """The score of the mean that the run reports: the confirmed one, else the best evaluation."""
        return self.confirmation() or best_evaluation(self.evaluations())

    def efforts(self) -> list[GenerationEffort]:
        """The steps and time of accepted results by generation; choosing and confirming the report is separate."""
        settings = self.settings
        begun = begun_stages(settings, self.history(), self.evaluations())
        rows = self._journal.rows("siiiff", efforts_query(begun))
        return [GenerationEffort(generation, bool(confirming), Effort.of(settings.task.task, kind, *made,
                                                                         driven=bool(driven)))
                for kind, generation, confirming, driven, *made in rows]  # fmt: skip

    def start_effort(self) -> Effort:
        """What had been spent before the run began: by the run that it forked, or on its first controller."""
        return parse_start_effort(self.fact(START_EFFORT)) or Effort()

    def total_effort(self) -> Effort:
        """What the run took so far, and what had been spent on its start."""
        return sum((each.effort for each in self.efforts()), self.start_effort())

    def effort_by_worker(self) -> list[WorkerEffort]:
        """What each worker did for each generation."""
        rows = self._journal.rows("sisiiff", WORK_QUERY)
        return [WorkerEffort(worker, generation, kind, bool(confirming), results, to_finite(steps), to_finite(seconds))
                for worker, generation, kind, confirming, results, steps, seconds in rows]  # fmt: skip

    def generation_times(self) -> dict[int, tuple[float, float | None]]:
        """When each generation was opened and closed, in seconds since 1970; `None` while it is open."""
        rows = self._journal.rows("ifF", "SELECT number, opened, closed FROM generation ORDER BY number")
        return {number: (opened, closed) for number, opened, closed in rows}

    def rollouts(self) -> list[Path]:
        """The files of all accepted rollouts, oldest first."""
        query = "SELECT generation, episode FROM result WHERE kind = 'collect' ORDER BY generation, episode"
        return [rollout_path(self.path, *row) for row in self._journal.rows("ii", query)]

    def strategy_state(self) -> bytes | None:
        """The optimiser's state before it was asked for the latest generation; `None` before the first."""
        self._check.check_state()
        rows = self._journal.rows("b", "SELECT state FROM strategy ORDER BY generation DESC LIMIT 1")
        return bytes(rows[0][0]) if rows else None

    def stage_at(self, generation: int) -> BegunStage:
        """The stage of a generation, which says how its candidates are scored."""
        return stage_at(generation, self.settings, self.history(), self.evaluations())

    @property
    def episode_limit(self) -> int | None:
        """Steps after which the environment itself ends an episode; `None` if it has no limit, or none is known."""
        text = self.fact(EPISODE_LIMIT)
        return int(text) if text and text.isdecimal() else None

    def fact(self, key: str) -> str | None:
        """One of the run's facts, such as its most recent limits; `None` if it has no such fact."""
        self._check.check_record()
        return self._journal.fact(key)

    def _vector(self, what: str, query: str, *values: int) -> NDArray[np.float32]:
        row = self._journal.row(query, *values)
        if row is None:
            raise JournalError(f"run {self.name} has no {what}")
        if not isinstance(row[0], bytes) or len(row[0]) % 4:
            raise self._journal.damage_error(f"{what} has no vector")
        return np.frombuffer(row[0], dtype="<f4").astype(np.float32)
