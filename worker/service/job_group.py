"""A turn: the jobs that a child scores together, and what comes of them."""

from __future__ import annotations

import hashlib
import math
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from dreamfleet.common.protocol.messages import MAX_UPLOAD, Job, Result, TaskSpec
from dreamfleet.common.protocol.result_bounds import LONGEST_EPISODE, clamp_count, rejection_reason

if TYPE_CHECKING:  # the child imports this module before it imports what scores
    from dreamfleet.worker.scoring.rollout import Rollout
    from dreamfleet.worker.scoring.scorer import Scorer
    from dreamfleet.worker.tasks.api import Score

MAX_TRACE = 8000  # characters, from the end, where the cause stands

JobWithVector = tuple[Job, bytes]
"""A job and its vector's bytes."""


@dataclass
class JobGroup:
    """Jobs that a child scores together, in one specification: one, or as many as its task's width."""

    number: int
    work: Sequence[JobWithVector]
    unwanted: set[bytes] = field(default_factory=set)

    @property
    def jobs(self) -> list[Job]:
        """Its jobs."""
        return [job for job, _ in self.work]

    @property
    def size(self) -> int:
        """Bytes of its vectors."""
        return sum(len(vector) for _, vector in self.work)


@dataclass(frozen=True)
class ScoringFailure:
    """What was raised: in one line, where it came from, and the whole traceback.

    Failures of one `kind` come from one line of code, whatever numbers their texts name.
    """

    text: str
    kind: str
    trace: str

    @classmethod
    def of(cls, error: Exception) -> ScoringFailure:
        """From an exception that was caught."""
        lines = str(error).strip().splitlines()
        places = traceback.extract_tb(error.__traceback__)
        place = f"{places[-1].filename}:{places[-1].lineno}" if places else "nowhere"
        name, first = type(error).__name__, lines[0] if lines else ""
        trace = "".join(traceback.format_exception(error)).rstrip()
        return cls(_plain(f"{name}: {first}"[:500]), f"{name} at {place}", _plain(trace[-MAX_TRACE:]))


@dataclass(frozen=True)
class GroupDone:
    """A child's word that a turn is over: a result of each of its jobs, or none where it was told to give up.

    A file that a job left comes through the pipe, never through a disk. A `failure` is why the results are errors.
    """

    group: int
    results: tuple[Result, ...]
    upload: bytes | None = None
    failure: ScoringFailure | None = None


def _plain(text: str) -> str:
    """Text that can travel: half a surrogate pair, as in the name of a file, cannot."""
    return text.encode(errors="replace").decode()


class AbandonedError(Exception):
    """The running turn is not wanted any more."""


def score_group(scorer: Scorer, group: int, work: Sequence[JobWithVector], count: Callable[[int], None]) -> GroupDone:
    """A result of each job; whatever a task raises is the jobs' error, not the slot's end.

    `count` hears of all steps made so far, and ends the turn by raising `AbandonedError`.
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
    except Exception as error:
        failure = ScoringFailure.of(error)
        each = clamp_count(made // len(work)), (perf_counter() - started) / len(work), failure.text
        return GroupDone(group, tuple(Result(job.digest, None, *each, None) for job, _ in work), failure=failure)


def _score(
    scorer: Scorer, work: Sequence[JobWithVector], on_step: Callable[[int], None], spec: TaskSpec
) -> tuple[list[Score], bytes | None]:
    """The score of each job, and the file of a kept rollout."""
    episodes = [(job.kind, np.frombuffer(vector, dtype="<f4"), job.seeds[0]) for job, vector in work]
    if episodes[0][0] == "collect":
        _, vector, seed = episodes[0]
        score, drive = scorer.collect(vector, seed, on_step, spec)
        return [score], _to_upload(drive)
    return scorer.score_all(episodes, on_step, spec), None


def _results(
    work: Sequence[JobWithVector], scores: list[Score], spent: float, upload: bytes | None, horizon: int
) -> tuple[Result, ...]:
    """A result of each job; `ValueError` where a task's scores are not one number a job that a run can count."""
    if len(scores) != len(work):
        raise ValueError(f"the task gave {len(scores)} scores of {len(work)} episodes")
    if not all(math.isfinite(score.fitness) for score in scores):
        raise ValueError("the task gave a fitness that is no number")
    if not all(0 <= int(score.steps) < 2**63 for score in scores):
        raise ValueError("the task gave a number of steps that is none")
    sha256 = None if upload is None else hashlib.sha256(upload).digest()
    return tuple(_result(job, score, spent, sha256, horizon) for (job, _), score in zip(work, scores, strict=True))


def _result(job: Job, score: Score, spent: float, sha256: bytes | None, horizon: int) -> Result:
    """A number that would spoil the run's is this job's error, and not that of the jobs that were scored with it."""
    fitness, steps = float(score.fitness), int(score.steps)
    why = rejection_reason(fitness, steps, spent, LONGEST_EPISODE if job.kind == "evaluate" else horizon)
    if why is None:
        return Result(job.digest, fitness, steps, spent, None, sha256)
    return Result(job.digest, None, clamp_count(steps), spent, why, None)


def _to_upload(drive: Rollout) -> bytes:
    data = drive.to_bytes()
    if len(data) > MAX_UPLOAD:
        raise ValueError(f"a rollout of {len(drive)} steps is larger than {MAX_UPLOAD >> 20} MiB: shorten the horizon")
    return data
