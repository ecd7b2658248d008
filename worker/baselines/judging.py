"""Baselines judged as controllers are: whole episodes in gymnasium's own environment, and how they were driven."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from time import perf_counter
from typing import Any

import gymnasium

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.evaluated import Drive, Evaluated
from dreamfleet.common.fingerprint import fingerprint, package_version
from dreamfleet.common.judgement import Judgement
from dreamfleet.common.threads import pin_thread_pools
from dreamfleet.worker.baselines.agents import Agent, find_agent
from dreamfleet.worker.baselines.policies import NOTHING
from dreamfleet.worker.car_racing.preprocessing import find_preprocessing
from dreamfleet.worker.car_racing.task import WORLD, CarRacing, judge_seeing
from dreamfleet.worker.scoring.episode import Course, score
from dreamfleet.worker.tasks.api import ENVIRONMENTS_OWN
from dreamfleet.worker.tools.evaluation import drive_in_processes
from dreamfleet.worker.tools.judge import Watch


class AgentJudge:
    """Drives an agent in the environment that reported scores come from, one episode after the other."""

    def __init__(self, agent: Agent) -> None:
        self._agent, self._environment = agent, environment_of(agent)

    def drive(self, seed: int) -> Drive:
        """One whole episode."""
        watch = Watch(WORLD, lambda: CarRacing().truth(self._environment))
        course = Course(seed, ENVIRONMENTS_OWN)
        return watch.drive(seed, score(self._environment, self._agent.policy(seed), NOTHING, course, see=watch.see))

    def close(self) -> None:
        """Release the environment."""
        self._environment.close()


def environment_of(agent: Agent, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    """Gymnasium's own environment, observing what the agent sees."""
    return judge_seeing(find_preprocessing(agent.preprocessing), render_mode)


def judge_agent(
    agent: Agent, name: str, data: Path | None, seeds: tuple[int, ...], jobs: int,
    on_drive: Callable[[list[Drive]], None] = lambda _drives: None,
) -> Judgement:  # fmt: skip
    """Drive one whole episode a seed in `jobs` processes; `on_drive` is shown those that have ended.

    `name` and `data` are what the agent was found by, and is again in each process.
    """
    began, drives = perf_counter(), list[Drive]()
    for drive in _drives(agent, name, data, seeds, jobs):
        drives.append(drive)
        on_drive(drives)
    return Judgement(
        name if data is None else f"{name} {data}", agent.sha256, CarRacing.name, CarRacing.name, "",
        fingerprint(agent.packages), package_version("dreamfleet") or "", perf_counter() - began,
        Evaluated.of(drives).drives, threshold=CarRacing.world.threshold,
    )  # fmt: skip


def _drives(agent: Agent, name: str, data: Path | None, seeds: tuple[int, ...], jobs: int) -> Iterator[Drive]:
    pin_thread_pools()
    if jobs > 1:
        yield from drive_in_processes(partial(_drive, name, data, agent.sha256), seeds, jobs)
        return
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    judge = AgentJudge(agent)
    yield from map(judge.drive, seeds)
    judge.close()


def _drive(name: str, data: Path | None, sha256: str, seed: int) -> Drive:
    return _judge(name, data, sha256).drive(seed)


@cache
def _judge(name: str, data: Path | None, sha256: str) -> AgentJudge:
    """One a process, made by its first drive, of the agent that was asked for: its training may have gone on."""
    agent = find_agent(name, data)
    if agent.sha256 != sha256:
        raise DatasetError(f"{data} has learnt on while it was judged: judge it again, or a copy of the folder")
    return AgentJudge(agent)
