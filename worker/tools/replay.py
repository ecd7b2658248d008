"""Scoring stored candidates again."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.runs import RunFolder
from dreamfleet.common.terms import terms_of
from dreamfleet.common.threads import pin_thread_pools


@dataclass(frozen=True)
class Replayed:
    """One episode's stored and recomputed fitness."""

    episode: int
    seed: int
    stored: float
    replayed: float


def replay(run: RunFolder, generation: int, candidate: int) -> Iterator[Replayed]:
    """Each stored episode of a candidate, scored again under its generation's terms, bundle and seeds."""
    parameters = run.candidate(generation, candidate)
    results = run.results(generation, candidate)
    pin_thread_pools()
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.worker.scoring.scorer import Scorer

    terms, own = terms_of(run, generation), run.spec
    scorer = Scorer(own, Bundle.open(run.bundle_path, own.bundle) if own.bundle else None)
    for result in results:
        score = scorer.score("score", parameters, result.seed, spec=terms.spec_of(result.episode))
        yield Replayed(result.episode, result.seed, result.fitness, score.fitness)
    scorer.close()
