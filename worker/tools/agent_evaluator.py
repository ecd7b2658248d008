"""Whole episodes in the environment that reported scores come from, and how they were driven."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import fmean

from dreamfleet.common.runs.episode_results import EpisodeResult
from dreamfleet.worker.scoring.agents import Agent
from dreamfleet.worker.scoring.episode import EpisodeConfig, Transition, score
from dreamfleet.worker.tasks.api import Score, World

SPEED, BRAKE = "speed", "brake"  # of a world's truth, and of its actions


class AgentEvaluator:
    """Drives an agent in the environment that reported scores come from, one episode after the other."""

    def __init__(self, agent: Agent) -> None:
        self._world, self._parameters = agent.world, agent.parameters
        self._environment, self._policies = agent.make_evaluation_environment(), agent.make_policies()
        self._truth = agent.truth

    def drive(self, seed: int) -> EpisodeResult:
        """One whole episode; the truth is only looked at, so that a score is the same whoever looks."""
        truth, episode_config = self._truth, EpisodeConfig(seed, self._world.horizon)
        watch = DriveStatistics(self._world, None if truth is None else lambda: truth(self._environment))
        driven = score(
            self._environment, self._policies(seed), self._parameters, episode_config, on_transition=watch.on_transition
        )
        return watch.drive(seed, driven)

    def close(self) -> None:
        """Release the environment."""
        self._environment.close()


class DriveStatistics:
    """Notes how one episode is driven, as far as its world lets it know."""

    def __init__(self, world: World, truth: Callable[[], dict[str, float]] | None) -> None:
        self._truth, self._finish = truth, world.finish
        named = truth is not None and BRAKE in world.action_names
        self._brake = world.action_names.index(BRAKE) if named else None
        self._speeds: list[float] = []
        self._braked: list[bool] = []
        self._finished = False

    def on_transition(self, moment: Transition) -> None:
        """One step that was made."""
        self._finished = bool(moment.info.get(self._finish, False))
        told = self._truth() if self._truth is not None else {}
        if SPEED in told:
            self._speeds.append(told[SPEED])
        if self._brake is not None:
            self._braked.append(bool(moment.action[self._brake] > 0))

    def drive(self, seed: int, score: Score) -> EpisodeResult:
        """The whole of it."""
        finished = self._finished if self._finish else None
        return EpisodeResult(seed, score.fitness, score.steps, finished, _mean(self._speeds), _mean(self._braked))


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None
