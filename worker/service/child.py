"""A scoring child process: it reads groups of jobs from a pipe and writes their results back. It never uses Zenoh.

This module imports nothing heavy: a child ends with its parent only once what it was started with is loaded.
"""

from __future__ import annotations

import faulthandler
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from dreamfleet.common.host.standard_streams import make_stderr_nonblocking, make_stdout_nonblocking
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.host.user_code import keep_user_arguments

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from pathlib import Path

    from dreamfleet.common.protocol.messages import TaskSpec
    from dreamfleet.worker.scoring.scorer import Scorer


@dataclass(frozen=True)
class ChildReady:
    """First message of a child: it can score.

    `drawn_by` names what draws its pictures; `side_by_side` says how many drives it does side by side.
    """

    drawn_by: str
    host_class: str
    side_by_side: int = 1


@dataclass(frozen=True)
class ScorerArguments:
    """What a child makes its scorer of. A task that is not in `allowed_tasks` is never imported."""

    spec: TaskSpec
    bundle: Path | None
    allowed_tasks: tuple[str, ...]
    torch_device: str = ""  # as in `Assignment`


def serve_jobs(
    pipe: Connection[Any, Any], steps: Any, abandoned: Any, is_watched: Any, arguments: ScorerArguments
) -> None:
    """Score groups of jobs from the pipe until it closes.

    `steps`, `abandoned` and `is_watched` are memory shared with the parent.
    """
    with suppress(OSError, AttributeError, ValueError, RuntimeError):  # without a stderr a crash leaves no traceback
        faulthandler.enable()
    make_stderr_nonblocking()  # inherited from the worker, whose reader may be suspended
    make_stdout_nonblocking()
    draw_unseen()
    keep_user_arguments()
    scorer = _make_scorer(pipe, arguments)
    _score_groups(pipe, scorer, steps, abandoned, is_watched)


def _make_scorer(pipe: Connection[Any, Any], arguments: ScorerArguments) -> Scorer:
    """Load the task and the world model and send `ChildReady`; on an error send a `ScoringFailure` and exit."""
    from dreamfleet.common.artifacts.bundle import Bundle
    from dreamfleet.common.errors import DreamfleetError
    from dreamfleet.worker.scoring.scorer import Scorer
    from dreamfleet.worker.service.failure_log import ScoringFailure
    from dreamfleet.worker.tasks.registry import check_task_allowed, check_world_allowed

    spec, bundle, allowed_tasks = arguments.spec, arguments.bundle, arguments.allowed_tasks
    try:
        check_task_allowed(spec.task, allowed_tasks)
        opened = None
        if bundle is not None:
            opened = Bundle.open(bundle, spec.bundle)
            check_world_allowed(opened, allowed_tasks)
        scorer = Scorer(spec, opened, arguments.torch_device)
        pipe.send(ChildReady(scorer.drawn_by, scorer.host_class, scorer.side_by_side))
        return scorer
    except BaseException as error:  # a simulator may raise `SystemExit`
        failure = ScoringFailure.of(error)
        # An expected error says all in its text.
        pipe.send(replace(failure, trace="") if isinstance(error, DreamfleetError) else failure)
        raise SystemExit(1) from None


def _score_groups(pipe: Connection[Any, Any], scorer: Scorer, steps: Any, abandoned: Any, is_watched: Any) -> None:
    """Score group after group until the parent closes the pipe.

    R9: a group whose jobs are no longer wanted (`abandoned`) ends at its next step, so that the slot is free again.
    """
    from dreamfleet.worker.service.frame_sampler import FrameSampler
    from dreamfleet.worker.service.job_group import AbandonedError, score_group

    sampler = FrameSampler(pipe.send, lambda: bool(is_watched.value))
    while True:
        try:
            group, work = pipe.recv()
        except EOFError:
            return

        def count(made: int) -> None:
            steps.value = made
            # The parent names the abandoned group in one of two cells, by even and odd, so that the next group is safe.
            if abandoned[group % 2] == group:  # noqa: B023 - called within this round
                raise AbandonedError

        scorer.observer = sampler.for_group(group) if is_watched.value else None
        pipe.send(score_group(scorer, group, work, count))
