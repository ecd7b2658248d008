"""A child process that scores: it knows nothing of Zenoh, takes turns from a pipe, and dies with its parent.

This module imports nothing heavy, so that a child has asked to die with its parent before it loads a simulator.
"""

from __future__ import annotations

import faulthandler
import os
import signal
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from dreamfleet.common.children import die_with
from dreamfleet.common.unblocked import unblock_stderr, unblock_stdout

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from pathlib import Path

    from dreamfleet.common.messages import TaskSpec
    from dreamfleet.worker.scoring.scorer import Scorer


@dataclass(frozen=True)
class Ready:
    """A child's first word: it can score, who draws its picture, and of which class its host is."""

    drawn_by: str
    host_class: str


def serve_jobs(
    pipe: Connection[Any, Any], steps: Any, abandoned: Any, shown: Any, spec: TaskSpec, bundle: Path | None,
    announced: tuple[str, ...], parent: int,
) -> None:  # fmt: skip
    """Score jobs from the pipe until it closes. `steps`, `abandoned` and `shown` are shared with the parent.

    Nothing is imported for a task that is not among the `announced` ones.
    """
    die_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the worker decides; Ctrl-C reaches the whole group
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    with suppress(OSError, AttributeError, ValueError, RuntimeError):  # no stderr: no traceback of a crash
        faulthandler.enable()
    unblock_stderr()  # whose reader is the worker's, and may be gone to sleep
    unblock_stdout()
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    scorer = _make_scorer(pipe, spec, bundle, announced)
    pipe.send(Ready(scorer.drawn_by, scorer.host_class))
    _take_turns(pipe, scorer, steps, abandoned, shown)


def _make_scorer(pipe: Connection[Any, Any], spec: TaskSpec, bundle: Path | None, announced: tuple[str, ...]) -> Scorer:
    """Load task and world model; what keeps them from loading is this child's last word."""
    from dreamfleet.common.bundle import Bundle
    from dreamfleet.worker.scoring.scorer import Scorer
    from dreamfleet.worker.service.announced import check_announced, check_world
    from dreamfleet.worker.service.turn import Failure

    try:
        check_announced(spec.task, announced)
        if bundle is None:
            return Scorer(spec)
        opened = Bundle.open(bundle, spec.bundle)
        check_world(opened, announced)
        return Scorer(spec, opened)
    except Exception as error:
        pipe.send(Failure.of(error))
        raise SystemExit(1) from error


def _take_turns(pipe: Connection[Any, Any], scorer: Scorer, steps: Any, abandoned: Any, shown: Any) -> None:
    from dreamfleet.worker.service.glimpses import Sampler
    from dreamfleet.worker.service.turn import AbandonedError, do_turn

    sampler = Sampler(pipe.send, lambda: bool(shown.value))
    while True:
        try:
            turn, work = pipe.recv()
        except EOFError:
            return

        def count(made: int) -> None:
            steps.value = made
            if abandoned[turn % 2] == turn:  # noqa: B023 - called within this round
                raise AbandonedError

        scorer.onlooker = sampler.of(turn) if shown.value else None
        pipe.send(do_turn(scorer, turn, work, count))
