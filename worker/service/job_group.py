"""Scoring a group of jobs in a child process: the group, and its results."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.measures import LARGEST_MEASURE
from dreamfleet.common.protocol.messages import MAX_SIDE_BY_SIDE, MAX_UPLOAD, Job, Result, TaskSpec
from dreamfleet.common.protocol.result_bounds import LONGEST_EPISODE, clamp_count, rejection_reason
from dreamfleet.worker.service.failure_log import ScoringFailure

if TYPE_CHECKING:  # the child imports this module before it imports what scores
    from dreamfleet.worker.scoring.scorer import Scorer
    from dreamfleet.worker.tasks.api import Score

MOST_TRIED_SINGLY = MAX_SIDE_BY_SIDE  # jobs of a failed group that are then tried one by one

JobWithVector = tuple[Job, bytes]
"""A job, and the bytes of its vector."""


@dataclass
class JobGroup:
    """Jobs of one specification that a child scores together: one, or up to the task's batch size."""

    number: int
    work: Sequence[JobWithVector]
    unwanted: set[bytes] = field(default_factory=set)

    @property
    def jobs(self) -> list[Job]:
        """The jobs without their vectors."""
        return [job for job, _ in self.work]

    @property
    def largest_size(self) -> int:
        """Bytes of the vectors of a group of such jobs, of which the next one may have more."""
        return max(len(vector) for _, vector in self.work) * max(len(self.work), MOST_TRIED_SINGLY)

    @property
    def stall(self) -> float:
        """Seconds without a step after which it hangs; 0: never. A few jobs may all begin, or take a step, in turn."""
        return max(job.stall for job in self.jobs) * (len(self.work) if self.is_small else 1)

    @property
    def is_small(self) -> bool:
        """Whether it has several jobs, but few enough to try them one by one."""
        return 1 < len(self.work) <= MOST_TRIED_SINGLY

    def split(self, wanted: Collection[bytes] | None = None) -> list[JobGroup]:
        """Its jobs for another child, or those with the digests `wanted`: one by one if the group is small."""
        work = [each for each in self.work if wanted is None or each[0].digest in wanted]
        parts = [[each] for each in work] if self.is_small else [work]
        return [JobGroup(0, part, self.unwanted & {job.digest for job, _ in part}) for part in parts]


@dataclass(frozen=True)
class GroupDone:
    """Message of a child that finished a group: one result a job, or none if the group was abandoned.

    `upload` is the rollout file of a job; it passes through the pipe, never through a disk. `failure` explains results
    that are errors.
    """

    group: int
    results: tuple[Result, ...]
    upload: bytes | None = None
    failure: ScoringFailure | None = None


class AbandonedError(Exception):
    """The running group is no longer wanted."""


def score_group(scorer: Scorer, group: int, work: Sequence[JobWithVector], count: Callable[[int], None]) -> GroupDone:
    """Score a group and return one result a job.

    R8: an exception of the task, also `SystemExit`, becomes an error of these jobs, because a wrong fitness would
    mislead the search. The slot lives on.
    `count` gets the number of steps so far, over all jobs; it may raise `AbandonedError` to end the group.
    """
    started, made = perf_counter(), 0

    def on_step(done: int) -> None:
        nonlocal made
        made = done
        count(done)

    try:
        count(0)
        spec = work[0][0].spec(scorer.spec)
        scores, upload = _score(scorer, work, on_step, spec)
        spent = (perf_counter() - started) / len(work)
        return GroupDone(group, _results(work, scores, spent, upload, spec.horizon), upload)
    except AbandonedError:
        return GroupDone(group, ())
    except BaseException as error:
        failure = ScoringFailure.of(error)
        each = clamp_count(made // len(work)), (perf_counter() - started) / len(work), failure.error
        return GroupDone(group, tuple(Result(job.digest, None, *each, None) for job, _ in work), failure=failure)


def _score(
    scorer: Scorer, work: Sequence[JobWithVector], on_step: Callable[[int], None], spec: TaskSpec
) -> tuple[list[Score], bytes | None]:
    """The score of each job, and the file of a collected rollout."""
    episodes = [(job.kind, np.frombuffer(vector, dtype="<f4"), job.seeds[0]) for job, vector in work]
    if episodes[0][0] == "collect":
        _, vector, seed = episodes[0]
        score, drive = scorer.collect(vector, seed, on_step, spec)
        if len(data := drive.to_bytes()) > MAX_UPLOAD:
            steps = plural(len(drive), "step")
            raise ValueError(f"a rollout of {steps} is larger than {MAX_UPLOAD >> 20} MiB: shorten the horizon")
        return [score], data
    return scorer.score_all(episodes, on_step, spec), None


def _results(
    work: Sequence[JobWithVector], scores: list[Score], spent: float, upload: bytes | None, horizon: int
) -> tuple[Result, ...]:
    """One result a job; `ValueError` if the task's scores are not one a job."""
    if len(scores) != len(work):
        raise ValueError(f"the task gave {plural(len(scores), 'score')} of {plural(len(work), 'episode')}")
    if not all(0 <= int(score.steps) < 2**63 for score in scores):
        raise ValueError("the task gave a number of steps that is not from 0 to 2**63 - 1")
    if not all(abs(each) <= LARGEST_MEASURE for score in scores for each in score.measures):
        raise ValueError("the task gave a measure that is not a finite number")
    sha256 = None if upload is None else hashlib.sha256(upload).digest()
    return tuple(_result(job, score, spent, sha256, horizon) for (job, _), score in zip(work, scores, strict=True))


def _result(job: Job, score: Score, spent: float, sha256: bytes | None, horizon: int) -> Result:
    """The result of one job.

    R8: a fitness or step count out of bounds, or no number, is this job's error: a wrong one would mislead the search.
    The jobs scored with it keep their results.
    """
    fitness, steps = float(score.fitness), int(score.steps)
    why = rejection_reason(fitness, steps, spent, LONGEST_EPISODE if job.kind == "evaluate" else horizon)
    if why is None:
        return Result(job.digest, fitness, steps, spent, None, sha256, tuple(map(float, score.measures)))
    return Result(job.digest, None, clamp_count(steps), spent, why, None)
