"""The two sources of live frames: a worker that scores, and a controller that is driven for the viewer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from time import monotonic, sleep
from typing import Any

from dreamfleet.common.addons.frames.live import LiveView
from dreamfleet.worker.addons.evaluation.agents import Agent
from dreamfleet.worker.addons.live.live_view import CaptionedFrame, LiveCanvas
from dreamfleet.worker.addons.recording.canvas import Frame
from dreamfleet.worker.addons.recording.drive_frames import FilmedPolicy, FramePainter, WorldModelView, episode_errors
from dreamfleet.worker.addons.recording.parallel_dream import ParallelDreamConfig
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tasks.closing import close_environment

Driver = tuple[Agent, dict[str, Any]]
"""An agent, and the facts about it for captions."""


def worker_frames(view: LiveView, canvas: LiveCanvas, rate: float) -> Iterator[CaptionedFrame | None]:
    """Yield a worker's newest frame `rate` times a second until the run is over; the last one again if none is new.

    `None` before the first frame.
    """
    shown, due = None, monotonic()
    while not view.is_over:
        due = max(due + 1 / rate, monotonic())
        if (live_frame := view.next(max(0.0, due - monotonic()))) is not None:
            shown = canvas.draw(live_frame)
        sleep(max(0.0, due - monotonic()))
        yield shown


def driven_frames(
    driver: Callable[[], Driver], dreaming: ParallelDreamConfig, rate: float, seed: int
) -> Iterator[CaptionedFrame]:
    """Frames of whole episodes, one seed after another from `seed` on; `rate` frames show a second of the world.

    `driver` is called before each episode and may return another agent each time.
    """
    for track in count(seed):
        agent, facts = driver()
        environment = agent.make_evaluation_environment("rgb_array")
        try:
            with episode_errors(track):
                yield from _episode(agent, facts, environment, replace(dreaming, seed=track), rate)
        finally:
            close_environment(environment)


def _episode(
    agent: Agent, facts: dict[str, Any], environment: Any, dreaming: ParallelDreamConfig, rate: float
) -> Iterator[CaptionedFrame]:
    """Frames of one episode; its seed is also the dream's."""
    seed, world, drawn = dreaming.seed, agent.world, list[Frame]()
    policy: Any = agent.make_policies()(seed)
    policy.begin(agent.parameters)
    model_view = None if agent.bundle is None else WorldModelView(agent.bundle, policy, agent.parameters, dreaming)
    every = max(1, round(world.frames_per_second / rate))
    filmed = FilmedPolicy(policy, FramePainter(environment, agent, seed, drawn.append, every), model_view)
    score = 0.0
    for moment in run_episode(environment, filmed, EpisodeConfig(seed, world.horizon)):
        if drawn:
            yield CaptionedFrame(drawn.pop(), {**facts, "seed": seed, "step": moment.step - 1, "score": score})
        score += moment.reward
    filmed.end(moment)
    for picture in drawn:
        yield CaptionedFrame(picture, {**facts, "seed": seed, "step": moment.step, "score": score})


def limit_rate(pictures: Iterator[CaptionedFrame], rate: float) -> Iterator[CaptionedFrame]:
    """At most `rate` frames a second; after a slow frame the following ones are not hurried."""
    due = monotonic()
    for shown in pictures:
        sleep(max(0.0, due - monotonic()))
        due = max(due, monotonic()) + 1 / rate
        yield shown
