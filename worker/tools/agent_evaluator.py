"""Evaluation episodes of an agent, with statistics of how it drove."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import fmean

from dreamfleet.common.runs.episode_results import EpisodeResult
from dreamfleet.worker.scoring.agents import Agent
from dreamfleet.worker.scoring.episode import EpisodeConfig, Transition, score
from dreamfleet.worker.tasks.api import Score, World
from dreamfleet.worker.tasks.closing import close_environment

SPEED, BRAKE = "speed", "brake"  # names in a task's true state, and among a world's actions


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
        self._truth, self._finish = truth, world.finish
        named = truth is not None and BRAKE in world.action_names
        self._brake = world.action_names.index(BRAKE) if named else None
        self._speeds: list[float] = []
        self._braked: list[bool] = []
        self._finished = False

    def on_transition(self, moment: Transition) -> None:
        """Add a step."""
        self._finished = bool(moment.info.get(self._finish, False))
        true_state = self._truth() if self._truth is not None else {}
        if SPEED in true_state:
            self._speeds.append(true_state[SPEED])
        if self._brake is not None:
            self._braked.append(bool(moment.action[self._brake] > 0))

    def drive(self, seed: int, score: Score) -> EpisodeResult:
        """The result of the whole episode."""
        finished = self._finished if self._finish else None
        return EpisodeResult(seed, score.fitness, score.steps, finished, _mean(self._speeds), _mean(self._braked))


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None
