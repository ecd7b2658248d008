"""Which evaluated mean a run reports, with an unbiased score. Pure: scores in, work out.

The best of many evaluations on few tracks is in part the luckiest. So the best few are driven again by successive
halving: all on some tracks, the better half on as many more, until one is left. The tracks that chose it favour it, so
its reported score comes from fresh tracks that chose nothing.

R28: everything follows from finished evaluations and from scores in the journal, with fixed seeds. So a coordinator
that restarts anywhere continues to the bit. Pages: dreams.md, measurements.md, results.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import fsum, isnan

import numpy as np

from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.records import StoredConfirmation
from dreamfleet.common.runs.seeds import CHOOSING_OFFSET, CONFIRMING_OFFSET, validation_seeds
from dreamfleet.common.runs.standard_error import sample_std
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob, make_jobs

FINALISTS = 4  # whose rounds have about twice the episodes of the confirmation, as --confirm-episodes says
FindScores = Callable[[list[ScoringJob]], Mapping[bytes, float]]
"""Finds the known scores of jobs, by digest; NaN for an episode that failed for good."""


@dataclass(frozen=True)
class Finalist:
    """The distribution's mean after `generation`, as float32 bytes, and its mean score on `episodes` tracks so far.

    On `failed` further tracks its episode failed for good.
    """

    generation: int
    vector: bytes
    episodes: int
    mean: float
    failed: int = 0

    def with_scores(self, scores: Sequence[float]) -> Finalist:
        """This finalist with a round's scores added, NaN for an episode that failed."""
        found = [score for score in scores if not isnan(score)]
        episodes = self.episodes + len(found)
        mean = fsum((self.mean * self.episodes, *found)) / episodes
        failed = self.failed + len(scores) - len(found)
        return Finalist(self.generation, self.vector, episodes, mean, failed)


class Confirmation:
    """One confirmation: each round has about `episodes` episodes, shared by the finalists that are left.

    `closed` is the number of closed generations of the run.
    """

    def __init__(self, spec: TaskSpec, episodes: int, finalists: Sequence[Finalist], closed: int) -> None:
        self.outcome: StoredConfirmation | None = None  # at the end
        self.failed = False  # each of the last episodes failed: there is no score to report
        self._spec = spec
        self._episodes = episodes
        self._closed = closed
        self._remaining = list(finalists)
        self._next = CHOOSING_OFFSET  # the first track of the next choosing round
        self._work: list[ScoringJob] = []  # of the open round, finalist by finalist
        self._digests: list[bytes] = []  # of its jobs
        self._scores: dict[bytes, float] = {}

    @property
    def progress(self) -> tuple[int, int]:
        """Episodes of the open round: done, wanted."""
        return len(self._scores), len(self._digests)

    @property
    def remaining_episodes(self) -> int:
        """Episodes until there is an outcome."""
        done, wanted = self.progress
        return wanted - done + total_episodes(_better_half(self._remaining), self._episodes)

    @property
    def round_description(self) -> str:
        """The open round in words."""
        count = len(self._digests) // len(self._remaining)
        if len(self._remaining) == 1:
            mean, episodes = self._remaining[0].generation, plural(count, "episode")
            return f"confirming: generation {mean}'s mean in {episodes} on fresh seeds, for its score"
        names = ", ".join(str(each.generation) for each in self._remaining)
        episodes = plural(count, "more episode")
        return f"confirming: the means of generations {names} in {episodes} each; the better half continues"

    @property
    def in_progress(self) -> bool:
        """Whether scores of the open round are missing."""
        return len(self._scores) < len(self._digests)

    def retry_failed(self) -> list[ScoringJob]:
        """Want the failed episodes of the open round again; their jobs."""
        failed = {digest for digest, score in self._scores.items() if isnan(score)}
        for digest in failed:
            del self._scores[digest]
        return [each for each in self._work if each.digest in failed]

    def advance(
        self, known: FindScores, is_checking: Callable[[Sequence[ScoringJob]], bool] = lambda _: False
    ) -> list[ScoringJob]:
        """Close a complete round and open the next one; return its missing jobs, none once there is an outcome.

        `is_checking` says of a round's jobs whether known results of them wait for a check. Such a round stays open.
        """
        missing: list[ScoringJob] = []
        while not self._is_over and not missing:
            if self._digests:
                self._close()
            if not self._is_over:
                missing = self._open(known)
                if is_checking(self._work):
                    break
        return missing

    @property
    def _is_over(self) -> bool:
        return self.outcome is not None or self.failed

    def record(self, digest: bytes, score: float) -> None:
        """Record one score, NaN for an episode that failed for good."""
        if digest in self._digests:
            self._scores[digest] = score

    def _open(self, known: FindScores) -> list[ScoringJob]:
        first, count = CONFIRMING_OFFSET, self._episodes
        if len(self._remaining) > 1:
            first, count = self._next, max(1, self._episodes // len(self._remaining))
            self._next += count
        seeds = validation_seeds(count, first)
        work = [
            job
            for each in self._remaining
            for job in make_jobs(self._spec, "evaluate", each.generation, 0, each.vector, seeds, first=first)
        ]
        self._work = work
        self._digests = [each.digest for each in work]
        self._scores = dict(known(work))
        return [each for each in work if each.digest not in self._scores]

    def _close(self) -> None:
        scores = np.array([self._scores[digest] for digest in self._digests]).reshape(len(self._remaining), -1)
        self._digests, self._scores = [], {}
        if len(self._remaining) == 1:
            found = scores[0][np.isfinite(scores[0])]
            self.failed = not len(found)
            self.outcome = None if self.failed else self._outcome(found, scores.size - len(found))
            return
        judged = [each.with_scores(row.tolist()) for each, row in zip(self._remaining, scores, strict=True)]
        judged.sort(key=lambda each: (each.failed, -each.mean, each.generation))
        self._remaining = judged[: _better_half(judged)]

    def _outcome(self, scores: np.ndarray[tuple[int], np.dtype[np.float64]], failed: int) -> StoredConfirmation:
        std = sample_std(scores.tolist()) or 0.0  # of one episode there is none, as `error` says
        last = self._remaining[0].generation
        return StoredConfirmation(last, len(scores), float(scores.mean()), std, self._closed, failed)


def total_episodes(finalists: int, episodes: int) -> int:
    """Episodes of a whole confirmation of so many finalists, with rounds of about `episodes` episodes."""
    if finalists < 2 or not episodes:
        return finalists * episodes
    return finalists * max(1, episodes // finalists) + total_episodes(-(-finalists // 2), episodes)


def _better_half(finalists: Sequence[Finalist]) -> int:
    """How many finalists go on; 0 if one is left."""
    return -(-len(finalists) // 2) if len(finalists) > 1 else 0
