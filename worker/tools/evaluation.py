"""Evaluating agents on unseen tracks, in gymnasium's own unmodified environment."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from time import perf_counter
from typing import ClassVar

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.host.parent_death import exit_with_parent
from dreamfleet.common.host.process_pool import map_in_processes
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.stop_signals import outlive_stop_signals
from dreamfleet.common.protocol.result_bounds import rejection_reason
from dreamfleet.common.runs.episode_results import EpisodeResult, EpisodeResults, FailedEpisode
from dreamfleet.common.runs.evaluation_report import EvaluationReport
from dreamfleet.worker.scoring.agents import Agent
from dreamfleet.worker.scoring.failure_cause import describe_exception
from dreamfleet.worker.tools.agent_evaluator import AgentEvaluator

Episode = EpisodeResult | FailedEpisode


def evaluate(agent: Agent, seeds: tuple[int, ...], jobs: int) -> Iterator[Episode]:
    """Drive one whole episode for each seed in `jobs` processes, or in this one if it is 1; yield each when it ends.

    An episode that fails does not end the others.
    """
    pin_thread_pools()
    if jobs == 1:  # in this process, so that a script needs no `if __name__ == "__main__"`
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        driver = _Driver(agent)
        yield from map(driver.drive, seeds)
        driver.close()
        return
    left = list(seeds)
    while left:
        try:
            for each in _drive_in_processes(agent, left, jobs):
                left.remove(each.seed)
                yield each
        except BrokenProcessPool as error:  # the seeds are handed out in order: one of the first crashed
            alone = [_drive_alone(agent, seed) for seed in left[:jobs]]
            if len(left) == len(seeds) and all(isinstance(each, FailedEpisode) for each in alone):
                raise DreamfleetError(
                    'a driving process has crashed; in your own script call this under `if __name__ == "__main__":` or '
                    "with jobs=1; otherwise `dreamfleet doctor` looks for the cause"
                ) from error
            yield from alone
            del left[:jobs]


def _drive_in_processes(agent: Agent, seeds: Sequence[int], jobs: int) -> Iterator[Episode]:
    """`BrokenProcessPool` if one of the processes crashes."""
    work = tuple(seeds)
    return map_in_processes(jobs, _ProcessEvaluator.start, (agent, os.getpid()), _ProcessEvaluator.drive, work)


def _drive_alone(agent: Agent, seed: int) -> Episode:
    """Drive one episode in a process of its own, which may crash."""
    try:
        (found,) = _drive_in_processes(agent, (seed,), 1)
        return found
    except BrokenProcessPool:
        return FailedEpisode(seed, "the driving process crashed")


def run_evaluation(
    name: str, agent: Agent, seeds: tuple[int, ...], jobs: int, on_episode: Callable[[list[Episode]], None]
) -> EvaluationReport:
    """Evaluate an agent and report it under `name`; `on_episode` gets all episodes so far after each."""
    began, episodes = perf_counter(), list[Episode]()
    for each in evaluate(agent, seeds, jobs):
        episodes.append(each)
        on_episode(episodes)
    results = EpisodeResults.of(episodes)
    return EvaluationReport(
        name, agent.sha256, agent.task, agent.reality, agent.bundle.sha256 if agent.bundle else "",
        fingerprint(agent.world.packages), package_version("dreamfleet") or "", perf_counter() - began,
        results.drives, threshold=agent.threshold, failed=results.failed,
    )  # fmt: skip


class _Driver:
    """Drives episodes; after one that failed it makes policy and environment anew, as they may be broken."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._evaluator: AgentEvaluator | None = None

    def drive(self, seed: int) -> Episode:
        """Drive one whole episode; a `DreamfleetError` passes through, as it concerns all of them."""
        try:
            if self._evaluator is None:
                self._evaluator = AgentEvaluator(self._agent)
            found = self._evaluator.drive(seed)
            why = rejection_reason(found.score, found.steps, 0.0, found.steps)
            return found if why is None else FailedEpisode(seed, why)
        except DreamfleetError:
            raise
        except (Exception, SystemExit) as error:  # a simulator may raise anything
            with suppress(Exception, SystemExit):
                self.close()
            self._evaluator = None
            return FailedEpisode(seed, describe_exception(error))

    def close(self) -> None:
        """Release the environment."""
        if self._evaluator is not None:
            self._evaluator.close()


class _ProcessEvaluator:
    """Drives episodes in a child process."""

    driver: ClassVar[_Driver]

    @classmethod
    def start(cls, agent: Agent, parent: int) -> None:
        """Initialise the process, which ends with its parent."""
        exit_with_parent(parent)
        os.environ["SDL_VIDEODRIVER"] = "dummy"
        outlive_stop_signals()  # Ctrl-C reaches the whole process group; the parent ends this process
        cls.driver = _Driver(agent)  # its first episode loads the agent, so that errors are reported as that episode's

    @classmethod
    def drive(cls, seed: int) -> Episode:
        """Drive one whole episode."""
        return cls.driver.drive(seed)
