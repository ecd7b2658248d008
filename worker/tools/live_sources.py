"""The two things that can be watched live: what a worker scores, and a controller that is driven for the viewer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from time import monotonic, sleep
from typing import Any

from dreamfleet.common.monitoring.live import LiveView
from dreamfleet.worker.dream.parallel_dream import ParallelDreamConfig
from dreamfleet.worker.scoring.agents import Agent
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tools.canvas import Frame
from dreamfleet.worker.tools.drive_frames import FilmedPolicy, FramePainter, WorldModelView
from dreamfleet.worker.tools.live_view import CaptionedFrame, LiveCanvas

Driver = tuple[Agent, dict[str, Any]]
"""Who drives, and the facts about him."""


def worker_frames(view: LiveView, glass: LiveCanvas, rate: float) -> Iterator[CaptionedFrame | None]:
    """What a worker does, `rate` times a second until the run is over: the newest there is, again if nothing is newer.

    `None` before the first frame.
    """
    shown, due = None, monotonic()
    while not view.is_over:
        due = max(due + 1 / rate, monotonic())
        if (sight := view.next(max(0.0, due - monotonic()))) is not None:
            shown = glass.draw(sight)
        sleep(max(0.0, due - monotonic()))
        yield shown


def driven_frames(
    driver: Callable[[], Driver], dreaming: ParallelDreamConfig, rate: float, seed: int
) -> Iterator[CaptionedFrame]:
    """Whole episodes on track after track from `seed` on, at the speed of the world where `rate` are shown a second.

    `driver` is asked before each episode, and may be another each time.
    """
    for track in count(seed):
        agent, facts = driver()
        environment = agent.make_evaluation_environment("rgb_array")
        try:
            yield from _episode(agent, facts, environment, replace(dreaming, seed=track), rate)
        finally:
            environment.close()


def _episode(
    agent: Agent, facts: dict[str, Any], environment: Any, dreaming: ParallelDreamConfig, rate: float
) -> Iterator[CaptionedFrame]:
    """One episode; the seed is the dream's too."""
    seed, world, drawn = dreaming.seed, agent.world, list[Frame]()
    policy: Any = agent.make_policies()(seed)
    policy.begin(agent.parameters)
    model_view = None if agent.bundle is None else WorldModelView(agent.bundle, policy, agent.parameters, dreaming)
    every = max(1, round(world.frames_per_second / rate))
    painter = FramePainter(environment, world, seed, drawn.append, every)
    score = 0.0
    for moment in run_episode(
        environment, FilmedPolicy(policy, painter, model_view), EpisodeConfig(seed, world.horizon)
    ):
        if drawn:
            yield CaptionedFrame(drawn.pop(), {**facts, "seed": seed, "step": moment.step - 1, "score": score})
        score += moment.reward


def limit_rate(pictures: Iterator[CaptionedFrame], rate: float) -> Iterator[CaptionedFrame]:
    """At most `rate` a second: what is slower than that stays slow, and nothing is made up for."""
    due = monotonic()
    for shown in pictures:
        sleep(max(0.0, due - monotonic()))
        due = max(due, monotonic()) + 1 / rate
        yield shown
