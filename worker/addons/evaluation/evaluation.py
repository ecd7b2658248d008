"""Evaluating agents on unseen seeds, in the environment that their task's reported scores come from."""

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from statistics import fmean
from time import perf_counter
from typing import Any

from dreamfleet.common.addons.evaluation_report import FAILED, SIGHTS, EvaluationReport, Sight, check_names
from dreamfleet.common.cli.progress import progress_bar
from dreamfleet.common.errors import DreamfleetError, StoppedError
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.host.process_pool import count_step, map_in_processes
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.stall_watch import STALL_SECONDS
from dreamfleet.common.host.unseen_drawing import draw_offscreen, draw_unseen
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.function_values import minimises
from dreamfleet.common.protocol.result_bounds import LARGEST_FITNESS, rejection_reason
from dreamfleet.common.runs.episode_results import EpisodeResult, EpisodeResults, FailedEpisode
from dreamfleet.common.runs.standard_error import format_with_error, standard_error
from dreamfleet.worker.addons.evaluation.agents import Agent, masked
from dreamfleet.worker.scoring.episode import EpisodeConfig, Transition, score
from dreamfleet.worker.scoring.failure_cause import crash, failure_of
from dreamfleet.worker.tasks.api import Score, World
from dreamfleet.worker.tasks.closing import close_environment
from dreamfleet.worker.worlds.function.task import ObjectiveError

Episode = EpisodeResult | FailedEpisode
log = logging.getLogger(__name__)
SPEED, BRAKE = "speed", "brake"  # names in a task's true state, and among a world's actions
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
    # A process has a copy, whose first episode loads the agent: its errors are that episode's. No Ctrl-C raises there.
    drive = _Driver(agent, (BaseException,)).drive
    for each in map_in_processes(jobs, draw_unseen, (), drive, seeds, lose, stall, has_failed=has_failed):
        ended = ended or each not in lost
        yield each


def judge(
    name: str,
    agent: Agent,
    seeds: tuple[int, ...],
    jobs: int,
    note: Callable[[str], object] = log.warning,
    how: str = "",
) -> EvaluationReport:
    """Drive one whole episode per seed, with a progress bar on stderr; `note` gets a line for each that fails.

    `name` is the agent's in the report, and `how` says how it drives if not as ever. `StoppedError` for a Ctrl-C once
    an episode has a score: it says the mean of those that have. `UsageError` for a world that no report can describe.
    """
    check_names(agent.world.figures, agent.world.marks)
    began = perf_counter()
    results = EpisodeResults.of(_drive_all(agent, seeds, jobs, note, how))
    return EvaluationReport(
        name=name, fingerprint=fingerprint(agent.world.packages), version=package_version("dreamfleet") or "",
        seconds=perf_counter() - began, drives=results.drives, failed=results.failed, **facts_of(agent),
    )  # fmt: skip


def judge_in_passes(
    name: str, agent: Agent, seeds: tuple[int, ...], jobs: int, note: Callable[[str], object], sights: Iterable[Sight]
) -> Iterator[EvaluationReport]:
    """Yield what `judge` gives, then the same with each of `sights` driven too.

    `UsageError` before the first episode if nothing hides in this world what decides.
    """
    others = {sight: masked(agent, sight) for sight in sights}
    yield (report := judge(name, agent, seeds, jobs, note))
    for sight, other in others.items():
        episodes = sorted(_drive_all(other, seeds, jobs, note, SIGHTS[sight]), key=lambda each: each.seed)
        found: dict[str, Any] = {
            sight: tuple(each for each in episodes if not has_failed(each)),
            sight + FAILED: tuple(each for each in episodes if has_failed(each)),
        }
        yield (report := replace(report, **found))


def _drive_all(
    agent: Agent, seeds: tuple[int, ...], jobs: int, note: Callable[[str], object], how: str
) -> list[Episode]:
    episodes, values = list[Episode](), list[float]()
    minimised, total = minimises(agent.task, agent.options), plural(len(seeds), "episode")
    with progress_bar(how or "evaluate", len(seeds), "episodes") as bar:
        try:
            for each in evaluate_in_processes(agent, seeds, jobs):
                episodes.append(each)
                values += [0.0 - each.score if minimised else each.score] if isinstance(each, EpisodeResult) else []
                bar.update(len(episodes), f"mean {format_with_error(fmean(values), None)}" if values else "")
                if isinstance(each, FailedEpisode):
                    note(f"an episode failed{how and f' ({how})'}: {each}")
        except KeyboardInterrupt:
            if not values:
                raise
            mean = format_with_error(fmean(values), standard_error(values))
            done = f"interrupted after {len(values)} of {total}{how and f' {how}'}"
            raise StoppedError(f"{done}: {mean}") from None
    return episodes


def facts_of(agent: Agent) -> dict[str, Any]:
    """A report's facts of an agent and its world, which is what a report of it must state."""
    world = agent.world
    return {
        "controller": agent.sha256, "task": agent.task, "options": agent.options, "world": agent.reality,
        "judge": world.judge or agent.reality, "bundle": agent.bundle.sha256 if agent.bundle else "",
        "threshold": world.threshold, "marks": tuple(map(float, world.marks)),
    }  # fmt: skip


class AgentEvaluator:
    """Drives an agent in its evaluation environment, one episode after another."""

    def __init__(self, agent: Agent) -> None:
        # First of all, so that nothing else makes one to ask for the world: many simulators allow one a process.
        self._environment = agent.make_evaluation_environment()
        try:
            self._world, self._parameters, self._truth = agent.world, agent.parameters, agent.truth
            self._policies = agent.make_policies()
        except BaseException:
            self.close()
            raise

    def drive(self, seed: int, on_step: Callable[[int], None] = lambda _steps: None) -> EpisodeResult:
        """Drive one whole episode; `on_step` gets the number of each step. The statistics do not change its score."""
        truth, episode_config = self._truth, EpisodeConfig(seed, self._world.horizon)
        watch = DriveStatistics(self._world, None if truth is None else lambda: truth(self._environment))
        driven = score(
            self._environment, self._policies(seed), self._parameters, episode_config, on_step,
            on_transition=watch.on_transition,
        )  # fmt: skip
        return watch.drive(seed, driven)

    def close(self) -> None:
        """Release the environment."""
        close_environment(self._environment)


class DriveStatistics:
    """Collects statistics of one episode, as far as its world reports them."""

    def __init__(self, world: World, truth: Callable[[], dict[str, float]] | None) -> None:
        self._truth, self._finish, self._named = truth, world.finish, world.figures
        named = truth is not None and BRAKE in world.action_names
        self._brake = world.action_names.index(BRAKE) if named else None
        self._speeds: list[float] = []
        self._braked: list[bool] = []
        self._info: dict[str, Any] = {}

    def on_transition(self, moment: Transition) -> None:
        """Add a step."""
        self._info = moment.info
        true_state = self._truth() if self._truth is not None else {}
        if SPEED in true_state:
            self._speeds.append(true_state[SPEED])
        if self._brake is not None:
            self._braked.append(bool(moment.action[self._brake] > 0))

    def drive(self, seed: int, score: Score) -> EpisodeResult:
        """The result of the whole episode."""
        finished = bool(self._info.get(self._finish, False)) if self._finish else None
        said = {name: _number(self._info.get(name)) for name in self._named}
        figures = {name: value for name, value in said.items() if value is not None} or None
        return EpisodeResult(
            seed, score.fitness, score.steps, finished, _mean(self._speeds), _mean(self._braked), figures
        )


def _number(said: Any) -> float | None:
    """What a world says as a number that a report can hold; `None` for anything else, which costs no score."""
    with suppress(TypeError, ValueError, OverflowError):
        return value if abs(value := float(said)) <= LARGEST_FITNESS else None
    return None


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None


class _Driver:
    """Drives episodes; after one that failed it makes policy and environment anew, as they may be broken."""

    def __init__(self, agent: Agent, caught: tuple[type[BaseException], ...]) -> None:
        self._agent, self._caught = agent, caught
        self._evaluator: AgentEvaluator | None = None

    def drive(self, seed: int) -> Episode:
        """Drive one whole episode; a `DreamfleetError` passes through, as it concerns all, but for a function's own."""
        try:
            if self._evaluator is None:
                self._evaluator = AgentEvaluator(self._agent)
                count_step()  # it is ready
            found = self._evaluator.drive(seed, count_step)
            rejection = rejection_reason(found.score, found.steps, 0.0, found.steps)
            if rejection is None:
                return found
            why = rejection.text
        except ObjectiveError as error:
            why = str(error)
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
