"""A baseline's drive as a video: the track and the pedals, for it has no world model to show."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dreamfleet.common.stopping import Stop, never
from dreamfleet.worker.baselines.agents import Agent
from dreamfleet.worker.baselines.judging import environment_of
from dreamfleet.worker.baselines.policies import NOTHING
from dreamfleet.worker.car_racing.task import WORLD
from dreamfleet.worker.scoring.episode import Course
from dreamfleet.worker.tools.recording import record_policy


def record_agent(
    agent: Agent, seed: int, steps: int, out: Path, on_step: Callable[[int], None] = lambda _steps: None,
    stop: Stop = never,
) -> float:  # fmt: skip
    """Drive one episode in gymnasium's own environment into an mp4; returns its score."""
    policy = agent.policy(seed)
    policy.begin(NOTHING)
    environment = environment_of(agent, "rgb_array")
    return record_policy(policy, environment, WORLD, Course(seed, steps), out, on_step=on_step, stop=stop)
