"""Evaluating agents on unseen seeds, in the environment that their task's reported scores come from."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from time import perf_counter
from typing import ClassVar

from dreamfleet.common.errors import DreamfleetError, StoppedError
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.host.process_pool import count_step, map_in_processes
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.stall_watch import STALL_SECONDS
from dreamfleet.common.host.unseen_drawing import draw_offscreen, draw_unseen
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.result_bounds import rejection_reason
from dreamfleet.common.runs.episode_results import EpisodeResult, EpisodeResults, FailedEpisode
from dreamfleet.common.runs.evaluation_report import EvaluationReport
from dreamfleet.common.runs.standard_error import format_with_error, standard_error
from dreamfleet.worker.scoring.agents import Agent
from dreamfleet.worker.scoring.failure_cause import crash, failure_of
from dreamfleet.worker.tools.agent_evaluator import AgentEvaluator

Episode = EpisodeResult | FailedEpisode
log = logging.getLogger(__name__)
FIRST_LOSSES = 3  # processes lost before any episode has ended, after which the evaluation ends


def evaluate(agent: Agent, seeds: tuple[int, ...], jobs: int) -> Iterator[Episode]:
    """Drive one whole episode for each seed in `jobs` processes, or in this one if it is 1; yield each when it ends.

    An episode that fails does not end the others, and fails again in a fresh process before it counts (R8). In this
    process, a fresh environment has to do, and an episode that crashes or hangs ends the others.
    """
    if jobs > 1:
        yield from evaluate_in_processes(agent, seeds, jobs)
        return
    pin_thread_pools()
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    draw_offscreen()
    # In this process, so that a script needs no `if __name__ == "__main__"`; Ctrl-C interrupts it.
    driver = _Driver(agent, (Exception, SystemExit))
    try:
        for number, seed in enumerate(seeds):
            found = driver.drive(seed)
            yield driver.drive(seed) if number and has_failed(found) else found
    finally:
        driver.close()


def has_failed(episode: Episode) -> bool:
    """Whether it has no score."""
    return isinstance(episode, FailedEpisode)


def evaluate_in_processes(
    agent: Agent, seeds: tuple[int, ...], jobs: int, stall: float = STALL_SECONDS
) -> Iterator[Episode]:
    """Like `evaluate`, in `jobs` processes. An episode fails that ends its process, or makes no step for `stall` s.

    `DreamfleetError` if the first processes are all lost before any episode has ended.
    """
    lost: list[Episode] = []
    ended = False

    def lose(seed: int, reason: int | str) -> Episode:
        error = crash(reason).text
        lost.append(FailedEpisode(seed, error))
        if not ended and len(lost) == max(jobs, FIRST_LOSSES):
            raise DreamfleetError(
                f"the first {len(lost)} driving processes are lost: {error}; in your own script call this under "
                '`if __name__ == "__main__":` or with jobs=1; otherwise `dreamfleet doctor` looks for the cause'
            )
        return lost[-1]

    pin_thread_pools()
    start, drive = _ProcessEvaluator.start, _ProcessEvaluator.drive
    for each in map_in_processes(jobs, start, (agent,), drive, seeds, lose, stall, has_failed=has_failed):
        ended = ended or each not in lost
        yield each


def run_evaluation(
    name: str, agent: Agent, seeds: tuple[int, ...], jobs: int, on_episode: Callable[[list[Episode]], None]
) -> EvaluationReport:
    """Evaluate an agent and report it under `name`; `on_episode` gets all episodes so far after each."""
    began, episodes = perf_counter(), list[Episode]()
    for each in evaluate_in_processes(agent, seeds, jobs):
        episodes.append(each)
        on_episode(episodes)
    results, world = EpisodeResults.of(episodes), agent.world
    return EvaluationReport(
        name, agent.sha256, agent.task, agent.reality, agent.bundle.sha256 if agent.bundle else "",
        fingerprint(world.packages), package_version("dreamfleet") or "", perf_counter() - began,
        results.drives, judge=world.judge or agent.reality, threshold=world.threshold, failed=results.failed,
        marks=tuple(map(float, world.marks)), options=agent.options,
    )  # fmt: skip


def judge(
    name: str, agent: Agent, seeds: tuple[int, ...], jobs: int, note: Callable[[str], object] = log.warning
) -> EvaluationReport:
    """Drive one whole episode per seed, with a progress bar on stderr; `note` gets a line for each that fails.

    `StoppedError` for a Ctrl-C once an episode has a score: it says the mean of those that have.
    """
    from dreamfleet.common.cli.progress import progress_bar

    def move(episodes: list[Episode]) -> None:
        so_far[:] = episodes
        scores = [each.score for each in episodes if isinstance(each, EpisodeResult)]
        bar.update(len(episodes), f"mean {format_with_error(sum(scores) / len(scores), None)}" if scores else "")
        if not isinstance(last := episodes[-1], EpisodeResult):
            note(f"an episode failed: {last}")

    so_far: list[Episode] = []
    with progress_bar("evaluate", len(seeds), "episodes") as bar:
        try:
            return run_evaluation(name, agent, seeds, jobs, move)
        except KeyboardInterrupt:
            scores = [each.score for each in so_far if isinstance(each, EpisodeResult)]
            if not scores:
                raise
            mean = format_with_error(sum(scores) / len(scores), standard_error(scores))
            raise StoppedError(f"interrupted after {len(scores)} of {plural(len(seeds), 'episode')}: {mean}") from None


class _Driver:
    """Drives episodes; after one that failed it makes policy and environment anew, as they may be broken."""

    def __init__(self, agent: Agent, caught: tuple[type[BaseException], ...]) -> None:
        self._agent, self._caught = agent, caught
        self._evaluator: AgentEvaluator | None = None

    def drive(self, seed: int) -> Episode:
        """Drive one whole episode; a `DreamfleetError` passes through, as it concerns all of them."""
        try:
            if self._evaluator is None:
                self._evaluator = AgentEvaluator(self._agent)
                count_step()  # it is ready
            found = self._evaluator.drive(seed, count_step)
            rejection = rejection_reason(found.score, found.steps, 0.0, found.steps)
            if rejection is None:
                return found
            why = rejection.text
        except DreamfleetError:
            raise
        except self._caught as error:  # a simulator may raise anything
            why = failure_of(error).text
        with suppress(*self._caught):
            self.close()
        self._evaluator = None
        return FailedEpisode(seed, why)

    def close(self) -> None:
        """Release the environment."""
        if self._evaluator is not None:
            self._evaluator.close()


class _ProcessEvaluator:
    """Drives episodes in a child process."""

    driver: ClassVar[_Driver]

    @classmethod
    def start(cls, agent: Agent) -> None:
        """Initialise the process."""
        draw_unseen()
        # The first episode loads the agent, so that errors are reported as that episode's. No Ctrl-C raises here.
        cls.driver = _Driver(agent, (BaseException,))

    @classmethod
    def drive(cls, seed: int) -> Episode:
        """Drive one whole episode."""
        return cls.driver.drive(seed)
