"""Evaluating agents on unseen tracks, in gymnasium's own unmodified environment."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from multiprocessing import get_context
from time import perf_counter
from typing import ClassVar

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.host.parent_death import end_on_signals, exit_with_parent, signals_blocked
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.runs.episode_results import EpisodeResult, EpisodeResults
from dreamfleet.common.runs.evaluation_report import EvaluationReport
from dreamfleet.worker.scoring.agents import Agent
from dreamfleet.worker.tools.agent_evaluator import AgentEvaluator


def evaluate(agent: Agent, seeds: tuple[int, ...], jobs: int) -> Iterator[EpisodeResult]:
    """Drive one whole episode for each seed in `jobs` processes, or in this one if it is 1; yield each when it ends."""
    pin_thread_pools()
    if jobs == 1:  # in this process, so that a script needs no `if __name__ == "__main__"`
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        evaluator = AgentEvaluator(agent)
        yield from map(evaluator.drive, seeds)
        evaluator.close()
        return
    pool = ProcessPoolExecutor(
        min(jobs, len(seeds)), get_context("spawn"), _ProcessEvaluator.start, (agent, os.getpid())
    )
    try:
        with signals_blocked():
            drives = [pool.submit(_ProcessEvaluator.drive, seed) for seed in seeds]
        for each in as_completed(drives):
            yield each.result()
    except BrokenProcessPool as error:
        raise DreamfleetError(
            'a driving process has crashed; in your own script call this under `if __name__ == "__main__":` or with '
            "jobs=1; otherwise `dreamfleet doctor` looks for the cause"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def run_evaluation(
    name: str, agent: Agent, seeds: tuple[int, ...], jobs: int, on_drive: Callable[[list[EpisodeResult]], None]
) -> EvaluationReport:
    """Evaluate an agent and report it under `name`; `on_drive` gets the results so far after each episode."""
    began, drives = perf_counter(), list[EpisodeResult]()
    for drive in evaluate(agent, seeds, jobs):
        drives.append(drive)
        on_drive(drives)
    return EvaluationReport(
        name, agent.sha256, agent.task, agent.reality, agent.bundle.sha256 if agent.bundle else "",
        fingerprint(agent.world.packages), package_version("dreamfleet") or "", perf_counter() - began,
        EpisodeResults.of(drives).drives, threshold=agent.threshold,
    )  # fmt: skip


class _ProcessEvaluator:
    """Drives episodes in a child process."""

    agent: ClassVar[Agent]

    @classmethod
    def start(cls, agent: Agent, parent: int) -> None:
        """Initialise the process, which ends with its parent."""
        exit_with_parent(parent)
        os.environ["SDL_VIDEODRIVER"] = "dummy"
        end_on_signals()  # Ctrl-C reaches the whole process group
        cls.agent = agent

    @classmethod
    def drive(cls, seed: int) -> EpisodeResult:
        """Drive one whole episode."""
        return cls._evaluator().drive(seed)

    @classmethod
    @cache
    def _evaluator(cls) -> AgentEvaluator:
        """Made by the first episode, so that its errors are reported as that episode's."""
        return AgentEvaluator(cls.agent)
