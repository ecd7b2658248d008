"""Recording a drive as a video."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.worker.dream.parallel_dream import ParallelDreamConfig
from dreamfleet.worker.scoring.agents import Agent
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tools.drive_frames import FilmedPolicy, FramePainter, WorldModelView, episode_errors
from dreamfleet.worker.tools.video import Video


def record(
    agent: Agent, seed: int, steps: int, out: Path, dreaming: ParallelDreamConfig | None = None,
    on_step: Callable[[int], None] = lambda _steps: None, stop: Stop = never_stop,
) -> float:  # fmt: skip
    """Record one episode of an agent in its evaluation environment as an mp4; return its score.

    With a world model, the video also shows what the model sees, decodes and, if it can, dreams. If `stop()` turns
    true, the video ends early, after at least one step.
    """
    environment = agent.make_evaluation_environment("rgb_array")
    policy: Any = agent.make_policies()(seed)
    policy.begin(agent.parameters)
    config, bundle = dreaming or ParallelDreamConfig(seed=seed), agent.bundle
    model_view = None if bundle is None else WorldModelView(bundle, policy, agent.parameters, config)
    score = 0.0
    with episode_errors(seed), Video(out, agent.world.frames_per_second) as video:
        painter = FramePainter(environment, agent.world, seed, video.add)
        for moment in run_episode(environment, FilmedPolicy(policy, painter, model_view), EpisodeConfig(seed, steps)):
            score += moment.reward
            on_step(moment.step)
            if stop():
                break
    environment.close()
    return score
