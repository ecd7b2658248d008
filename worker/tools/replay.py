"""Scoring stored candidates again, to compare with the stored fitness."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC, class_from_fingerprint
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.scoring_params import scoring_params_of


@dataclass(frozen=True)
class ReplayedEpisode:
    """Stored and recomputed fitness of one episode."""

    episode: int
    seed: int
    stored: float
    replayed: float
    host_class: str  # of the host that scored it
    own: bool  # whether this host is of the same class, so that the bits must be equal
    deterministic: bool = True  # whether equal episodes give equal bits, as far as hosts have found

    @property
    def same(self) -> bool:
        """Whether both are equal to the bit."""
        return self.stored == self.replayed

    def agrees(self, tolerance: float | None) -> bool | None:
        """Whether both agree; `None` if this host cannot decide it.

        A host of another class may differ by `tolerance`; without a tolerance only equality can be decided there.
        """
        if self.same or self.own:
            return self.same
        return None if tolerance is None else abs(self.stored - self.replayed) <= tolerance


def replay(run: RunFolder, generation: int, candidate: int) -> Iterator[ReplayedEpisode]:
    """Score each stored episode of a candidate again, with its generation's parameters, bundle and seeds."""
    parameters = run.candidate(generation, candidate)
    results = run.results(generation, candidate)
    pin_thread_pools()
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.worker.scoring.scorer import Scorer

    scoring_params, own = scoring_params_of(run, generation), run.spec
    scorer = Scorer(own, Bundle.open(run.bundle_path, own.bundle) if own.bundle else None)
    here = {scorer.host_class, class_from_fingerprint(fingerprint(run.settings.packages))}
    for result in results:
        score = scorer.score("score", parameters, result.seed, spec=scoring_params.episode_spec(result.episode))
        deterministic = NON_DETERMINISTIC not in (scorer.host_class, result.host_class)
        yield ReplayedEpisode(
            result.episode, result.seed, result.fitness, score.fitness, result.host_class,
            deterministic and result.host_class in here, deterministic,
        )  # fmt: skip
    scorer.close()
