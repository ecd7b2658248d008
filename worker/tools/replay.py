"""Scoring stored candidates again, to compare with the stored fitness."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.protocol.failures import failure_cause
from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC, class_from_fingerprint
from dreamfleet.common.runs.records import StoredFailure, StoredResult
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.scoring_params import ScoringParams, scoring_params_of
from dreamfleet.worker.scoring.failure_cause import describe_exception, is_crash

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dreamfleet.common.protocol.messages import TaskSpec
    from dreamfleet.worker.scoring.scorer import Scorer


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
    failure: str = ""  # the stored error; empty: it has a score
    error: str = ""  # the error now

    @property
    def same(self) -> bool:
        """Whether both are equal to the bit, or failed for the same cause."""
        return self.stored == self.replayed and failure_cause(self.failure) == failure_cause(self.error)

    @property
    def attempted(self) -> bool:
        """Whether it was driven again; an episode that would end or block this program is not."""
        return self.replayed is not None or bool(self.error)

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


def replay(run: RunFolder, generation: int, candidate: int) -> Iterator[ReplayedEpisode]:
    """Drive each stored episode of a candidate again, with its generation's parameters, bundle and seeds.

    Episodes of a vector that was discarded and drawn anew are left out.
    """
    with run.read_transaction():
        parameters = run.candidate(generation, candidate)
        scoring_params, own = scoring_params_of(run, generation), run.spec
        stored = _stored_episodes(run, generation, candidate, scoring_params)
    pin_thread_pools()
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.worker.scoring.scorer import Scorer

    scorer = Scorer(own, Bundle.open(run.bundle_path, own.bundle) if own.bundle else None)
    here = {scorer.host_class, class_from_fingerprint(fingerprint(run.settings.packages))}
    for each in stored:
        spec = scoring_params.episode_spec(each.episode)
        if isinstance(each, StoredFailure):
            # R8: a failure for good was independent of the host.
            fitness, host_class, failure, comparable = None, "", each.error, True
        else:
            fitness, host_class, failure = each.fitness, each.host_class, ""
            comparable = host_class in here
        replayed, error = (None, "") if is_crash(failure) else _drive(scorer, parameters, each.seed, spec)
        deterministic = NON_DETERMINISTIC not in (scorer.host_class, host_class)
        yield ReplayedEpisode(
            each.episode, each.seed, fitness, replayed, host_class, deterministic and comparable, deterministic,
            failure, error,
        )  # fmt: skip
    scorer.close()


def _stored_episodes(
    run: RunFolder, generation: int, candidate: int, params: ScoringParams
) -> list[StoredResult | StoredFailure]:
    """The results and failures of a candidate's final vector, by episode."""
    vector = hashlib.sha256(run.candidate(generation, candidate).astype("<f4").tobytes()).digest()

    def is_final(each: StoredResult | StoredFailure) -> bool:
        digest = params.episode_spec(each.episode).digest("score", vector, (each.seed,))
        return bytes.fromhex(each.digest) == digest

    place = "score", generation, candidate
    failures = [each for each in run.failures() if (each.kind, each.generation, each.candidate) == place]
    stored: list[StoredResult | StoredFailure] = [*run.results(generation, candidate), *failures]
    return sorted(filter(is_final, stored), key=lambda each: each.episode)


def _drive(
    scorer: Scorer, parameters: NDArray[np.float32], seed: int, spec: TaskSpec
) -> tuple[float | None, str]:  # fmt: skip
    """An episode's fitness, or `None` and the error."""
    try:
        return scorer.score("score", parameters, seed, spec=spec).fitness, ""
    except (Exception, SystemExit) as error:  # a simulator may raise anything
        return None, describe_exception(error)
