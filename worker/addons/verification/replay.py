"""Scoring stored candidates again, to compare with the stored fitness."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.addons.own_modules import trust_own_run
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.host.process_pool import count_step, map_in_processes
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.stall_watch import STALL_SECONDS
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC, class_from_fingerprint
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import check_task_trusted
from dreamfleet.common.runs.records import StoredFailure, StoredResult
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import Stage
from dreamfleet.worker.scoring.failure_cause import crash, failure_of

if TYPE_CHECKING:
    from dreamfleet.worker.scoring.scorer import Scorer

Item = tuple[int, NDArray[np.float32], int, TaskSpec]  # episode, parameters, seed and how it is driven


@dataclass(frozen=True)
class ReplayAttempt:
    """What an episode came to now: its fitness, or an error; neither: it was not driven."""

    episode: int
    host_class: str = ""  # of this host; empty: unknown
    fitness: float | None = None
    error: Failure | None = None


@dataclass(frozen=True)
class ReplayedEpisode:
    """Stored and recomputed fitness of one episode; `None` for an attempt that failed."""

    episode: int
    seed: int
    stored: float | None
    replayed: float | None
    host_class: str  # of the host that scored it
    own: bool  # whether this host is of the same class, so that the bits must be equal
    deterministic: bool = True  # whether equal episodes give equal bits, as far as hosts have found
    failure: Failure | None = None  # the stored one; `None`: it has a score
    error: Failure | None = None  # now

    @property
    def same(self) -> bool:
        """Whether both are equal to the bit, or failed for the same cause."""
        return self.stored == self.replayed and _cause(self.failure) == _cause(self.error)

    @property
    def attempted(self) -> bool:
        """Whether it was driven again; an episode that would end or block its process is not."""
        return self.replayed is not None or self.error is not None

    def agrees(self, tolerance: float | None) -> bool | None:
        """Whether both agree; `None` if this host cannot decide it.

        A host of another class may differ by `tolerance`; without a tolerance only equality can be decided there.
        """
        if not self.attempted:
            return None
        if self.same or self.own:
            return self.same
        if self.stored is None or self.replayed is None:
            return None if tolerance is None else False
        return None if tolerance is None else abs(self.stored - self.replayed) <= tolerance


def replay(
    run: RunFolder, generation: int, candidate: int, stall: float = STALL_SECONDS, torch_device: str = ""
) -> Iterator[ReplayedEpisode]:
    """Drive each stored episode of a candidate again, with its generation's parameters, bundle and seeds.

    It drives in a child process: an episode that ends it, or makes no step for `stall` seconds, has that error now. An
    episode that fails does so in a fresh process (R8). Left out are episodes of a vector that was drawn anew, and those
    on seeds that were replaced.
    """
    trust_own_run(run.uid, run.spec.task, run.spec.options)
    check_task_trusted(run.spec.task)
    with run.read_transaction():
        parameters = run.candidate(generation, candidate)
        stage, own = run.stage_at(generation).stage, run.spec
        stored = _stored_episodes(run, generation, candidate, stage)
    failures = {each.episode: each.failure for each in stored if isinstance(each, StoredFailure)}
    specs = {each.episode: stage.episode_spec(each.episode) for each in stored}
    items = [
        (each.episode, parameters, each.seed, specs[each.episode])
        for each in stored
        if not _ends_process(failures.get(each.episode))
    ]
    driven = _drive_all(own, run.bundle_path if own.bundle else None, items, stall, torch_device)
    here = {*(each.host_class for each in driven.values()), class_from_fingerprint(fingerprint(run.settings.packages))}
    for each in stored:
        now = driven.get(each.episode, ReplayAttempt(each.episode))
        if isinstance(each, StoredFailure):
            # R8: a failure for good was independent of the host.
            fitness, host_class, comparable = None, "", True
        else:
            # An episode that ends or blocks its process differs, wherever it had a score.
            fitness, host_class, comparable = each.fitness, each.host_class, _ends_process(now.error)
        comparable = comparable or host_class in here
        deterministic = NON_DETERMINISTIC not in (*here, host_class)
        yield ReplayedEpisode(
            each.episode, each.seed, fitness, now.fitness, host_class, deterministic and comparable, deterministic,
            failures.get(each.episode), now.error,
        )  # fmt: skip


def _cause(failure: Failure | None) -> str | None:
    return None if failure is None else failure.cause


def _ends_process(failure: Failure | None) -> bool:
    return failure is not None and failure.ends_process


def _stored_episodes(
    run: RunFolder, generation: int, candidate: int, stage: Stage
) -> list[StoredResult | StoredFailure]:
    """The results and failures of a candidate's final vector on the generation's final seeds, by episode."""
    seeds = dict(enumerate(run.training_seeds(generation)))
    vector = hashlib.sha256(run.candidate(generation, candidate).astype("<f4").tobytes()).digest()

    def is_final(each: StoredResult | StoredFailure) -> bool:
        digest = stage.episode_spec(each.episode).digest("score", vector, (each.seed,))
        return each.seed == seeds.get(each.episode) and bytes.fromhex(each.digest) == digest

    place = "score", generation, candidate
    failures = [each for each in run.failures() if (each.kind, each.generation, each.candidate) == place]
    stored: list[StoredResult | StoredFailure] = [*run.results(generation, candidate), *failures]
    return sorted(filter(is_final, stored), key=lambda each: each.episode)


def _drive_all(
    spec: TaskSpec, bundle: Path | None, items: Sequence[Item], stall: float, torch_device: str
) -> dict[int, ReplayAttempt]:
    """Drive the episodes one after another in a child process; the attempts by episode."""

    def lose(item: Item, reason: int | str) -> ReplayAttempt:
        return ReplayAttempt(item[0], error=crash(reason))

    pin_thread_pools()
    attempts = map_in_processes(
        1, draw_unseen, (), _Replayer(spec, bundle, torch_device).drive, items, lose, stall,
        has_failed=lambda attempt: attempt.error is not None,
    )  # fmt: skip
    return {each.episode: each for each in attempts}


class _Replayer:
    """Drives episodes in a child process, which has a copy of it."""

    def __init__(self, spec: TaskSpec, bundle: Path | None, torch_device: str) -> None:
        self._spec, self._bundle, self._torch_device = spec, bundle, torch_device
        self._scorer: Scorer | None = None

    def drive(self, item: Item) -> ReplayAttempt:
        """Drive one episode; `DreamfleetError` if the task cannot be scored here."""
        from dreamfleet.worker.scoring.scorer import Scorer

        episode, parameters, seed, spec = item
        host_class = ""
        try:
            if self._scorer is None:
                opened = None if self._bundle is None else Bundle.open(self._bundle, self._spec.bundle)
                self._scorer = Scorer(self._spec, opened, self._torch_device)
            host_class = self._scorer.host_class  # before the episode, as it drives the environment too
            count_step()
            score = self._scorer.score("score", parameters, seed, count_step, spec=spec)
            return ReplayAttempt(episode, host_class, score.fitness)
        except BaseException as error:  # a simulator may raise anything, and no Ctrl-C raises here
            if self._scorer is None and isinstance(error, DreamfleetError):
                raise
            return ReplayAttempt(episode, host_class, error=failure_of(error))
